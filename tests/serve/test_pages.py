"""What the pages of a server say, asked without a browser."""

import re
import time
from urllib.parse import quote

import pytest

from tests.program import wait_for
from tests.serve.conftest import HOSTILE, SWEPT, Served, hollow_run, write_sample


def names(text: str) -> list[str]:
    """Runs of a list, in their order."""
    return re.findall(r'href="/run/\w+">([^<]*)<', text)


def test_the_list_shows_the_latest_and_turns_over(served: Served) -> None:
    first = served.ask("/").text
    assert f"1 to 100 of {SWEPT + 3} runs" in first and len(names(first)) == 100
    (more,) = re.findall(r'rel="next" href="([^"]*)"', first)
    rest = served.ask(more.replace("&amp;", "&")).text
    assert len(set(names(first)) | set(names(rest))) == SWEPT + 3
    assert 'rel="prev"' in rest and 'rel="next"' not in rest


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("filter=" + quote("plant.prior_seed < 3 and path like '*sweep*'"), ["0", "1", "2"]),
        ("filter=" + quote("plant.prior_seed in (7, 8)") + "&controller=pid", ["7"]),
        ("controller=lqr&filter=" + quote("0 < plant.prior_seed < 5"), ["2", "4"]),
    ],
)
def test_the_filter_is_that_of_trms_runs_and_goes_with_what_is_chosen(
    served: Served, query: str, expected: list[str]
) -> None:
    listed = names(served.ask(f"/?{query}&sort=plant.prior_seed").text)
    assert listed == [f"sweep/{number}" for number in expected]


def test_a_head_sorts_all_runs_and_not_those_of_the_page(served: Served) -> None:
    text = served.ask("/?filter=" + quote("path like '*sweep*'")).text
    (address,) = re.findall(r'<a href="([^"]*)">rmse pitch', text)
    rising = names(served.ask(address.replace("&amp;", "&")).text)
    falling = names(
        served.ask(address.replace("&amp;", "&").replace("ascending", "descending")).text
    )
    order = sorted(range(SWEPT), key=lambda number: (37 * number) % 101)
    assert rising == [f"sweep/{number}" for number in order[:100]]
    assert falling == [f"sweep/{number}" for number in order[:0:-1]]


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("filter=rmse_yaw+%3C", "the filter, character"),
        ("filter=controller+%3D%3D+pid", "no column &#39;pid&#39;"),
        ("filter=__import__('os').remove('x')", "the filter, character"),
        ("sort=nonsense", "no column &#39;nonsense&#39;"),
        ("filter=" + 5000 * "x", "filter"),
    ],
)
def test_what_cannot_be_asked_is_told_with_its_place(
    served: Served, query: str, words: str
) -> None:
    answer = served.ask(f"/?{query}")
    assert answer.status == 400 and 'role="alert"' in answer.text and words in answer.text
    assert names(answer.text) == []


def test_an_address_that_says_nonsense_is_answered(served: Served) -> None:
    for query in ("page=0", "page=-1", "page=%C2%B2", "page=x", "order=x", "page=999999", "run=1"):
        assert served.ask(f"/?{query}").status == 200


def test_text_of_strangers_is_text(served: Served) -> None:
    text = served.ask("/?outcome=failed").text
    assert "&lt;b&gt;&amp;&#x27;" in text or "&lt;b&gt;&amp;&#39;" in text
    assert HOSTILE not in text and "&lt;img src=x" in text
    hostile = quote("'\"><script>x</script>")
    for query in (f"filter={hostile}", f"controller={hostile}", f"sort={hostile}"):
        assert "<script>x" not in served.ask(f"/?{query}").text


def test_a_run_has_the_report_of_trms_report(served: Served) -> None:
    text = served.ask(f"/run/{served.key('pid')}").text
    assert "<h1>pid on" in text and "Angles and commands" in text and "RMSE pitch" in text
    assert text.count('class="plot-data"') > 5
    assert 'id="plotly" data-address="/assets/plotly-' in text and len(text) < 500_000


def test_runs_are_compared_side_by_side(served: Served) -> None:
    keys = [served.key(name) for name in ("pid", "lqr")]
    text = served.ask(f"/compare?run={keys[0]}&run={keys[1]}&run={keys[0]}").text
    assert "<h1>Comparison of pid and lqr" in text and "How they differ" in text
    alone = served.ask(f"/compare?run={keys[0]}")
    assert (alone.status, alone.headers["location"]) == (303, f"/run/{keys[0]}")
    assert served.ask("/compare").headers["location"] == "/"


def test_many_runs_and_whole_folders_are_told_as_a_sweep(served: Served) -> None:
    keys = [served.key(f"sweep/{number}") for number in range(9)]
    text = served.ask("/compare?" + "&".join(f"run={key}" for key in keys)).text
    assert "9 of 9 runs completed" in text and f'href="/run/{keys[4]}"' in text
    (folder,) = re.findall(r'href="(/folder/\w+)">sweep<', served.ask("/").text)
    text = served.ask(folder).text
    assert f"{SWEPT} of {SWEPT} runs completed" in text and f'href="/run/{keys[4]}"' in text
    many = "/compare?" + "&".join(f"run={key}{n}" for key in keys for n in range(30))
    assert "choose up to 200" in served.ask(many).text


def test_no_run_yet_tells_what_to_type(serving, tmp_path) -> None:
    new = serving(tmp_path)
    text = new.ask("/").text
    assert "No run yet" in text and "run controller=pid ref=square" in text
    assert "data-refresh" in text  # and the first one appears by itself
    hollow_run(tmp_path / "first", controller="pid")
    wait_for(lambda: names(new.ask("/").text) == ["first"], 10)


def test_a_run_that_goes_on_is_live_until_its_end(serving, tmp_path) -> None:
    new = serving(tmp_path)
    log = hollow_run(tmp_path / "first", controller="pid", ending=None)
    text = new.ask("/").text
    assert '<td class="good short">live</td>' in text and "is going on: first" in text
    (address,) = re.findall(r'href="(/run/\w+)">first', text)
    before = new.ask(address).text
    assert "<strong>Live</strong>" in before and 'data-refresh="1.0"' in before
    for number in range(3, 150):
        write_sample(log, number)
    log.flush()
    after = new.ask(address).text
    times = [re.findall(r"<dt>time</dt><dd>([\d.]+)", text)[0] for text in (before, after)]
    assert times == ["0.04", "2.98"]
    log.close("completed", None)
    ended = new.ask(address).text
    assert "data-refresh" not in ended and "Circumstances" in ended
    time.sleep(1.1)  # the folder is looked through once a second at most
    assert "live</td>" not in new.ask("/").text


def test_a_log_that_is_gone_is_told(serving, tmp_path) -> None:
    new = serving(tmp_path)
    log = hollow_run(tmp_path / "first", controller="pid")
    (address,) = re.findall(r'href="(/run/\w+)">first', new.ask("/").text)
    log.path.unlink()
    answer = new.ask(address)
    assert answer.status == 404 and "no such run, or no more" in answer.text
