"""Runs in a notebook, with and without pandas."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from trms_cli.commands.runs import HELP
from trms_cli.core.errors import TrmsError
from trms_cli.runs import find_runs, runs_frame, runs_table
from trms_cli.runs.columns import ALIASES, COLUMNS
from trms_cli.runs.filter import translate_filter


def test_a_table_has_types_units_and_what_find_runs_says(write_run, score):
    write_run("a", overrides=["plant.prior_seed=3"])
    write_run("b", scored=score(rmse_alpha_h=None), ending="failed")
    columns = ["path", "complete", "seed", "rmse_yaw", "plant.prior_seed"]
    table = runs_table(columns=columns, sort="rmse_yaw")
    assert table.to_pylist() == find_runs(columns=columns, sort="rmse_yaw")
    types = [str(field.type) for field in table.schema]
    assert types == ["string", "bool", "int64", "double", "double"]
    assert table.schema.field("rmse_yaw").metadata[b"unit"] == b"rad"
    assert runs_table().column_names == list(COLUMNS)
    assert runs_table("seed == 1").num_rows == 0


def test_values_of_several_types_become_text(write_run):
    write_run("a", overrides=["plant.x=3"])
    write_run("b", overrides=["plant.x=three"])
    assert sorted(runs_table(columns=["plant.x"])["plant.x"].to_pylist()) == ["3", "three"]


@pytest.mark.skipif(find_spec("pandas") is None, reason="pandas is no dependency")
def test_a_frame(write_run, score):
    write_run("a")
    write_run("b", scored=score(rmse_alpha_h=None))
    frame = runs_frame("controller == 'pid'", sort="rmse_yaw")
    assert frame["rmse_alpha_h"].tolist()[0] == 0.1
    assert frame["rmse_alpha_h"].isna().tolist() == [False, True]
    assert frame["time"].dt.tz is not None
    assert frame.attrs["units"]["duration"] == "s"


def test_without_pandas_it_says_what_to_install(write_run, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(TrmsError) as caught:
        runs_frame()
    assert "pip install pandas" in caught.value.remedy


def test_every_other_name_is_that_of_a_column():
    assert set(ALIASES.values()) <= set(COLUMNS)
    assert not set(ALIASES) & set(COLUMNS)
    assert ALIASES["rmse_yaw"] == "rmse_alpha_h"
    assert ALIASES["settling_time_pitch"] == "settling_time_alpha_v"
    assert ALIASES["effort_tail"] == "effort_u_h"


def test_a_run_that_tells_of_itself_loads_no_database(tmp_path):
    code = "import sys, trms_cli.runs.place; print('sqlite3' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "False\n"


class TestPage:
    """What the page and the help say."""

    page = (Path(__file__).parents[2] / "docs" / "runs.md").read_text(encoding="utf-8")

    def test_every_column_is_told_of(self):
        for name in COLUMNS:
            stem = re.sub(r"_(alpha|u)_[vh]$", "", name)
            assert f"`{stem}`" in self.page or f"`{stem}_" in self.page, name
            assert re.search(rf"\b{stem}\b", HELP), name

    def test_its_filters_are_filters(self):
        typed = re.findall(r'(?:trms runs|runs_frame\() ?"([^"]+)"', self.page + HELP)
        rows = re.findall(r"^\| (`.*?) \| ", self.page.partition("## Columns")[0], re.MULTILINE)
        shown = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
        words = {"and", "or", "not", "not like", "not contains"}
        filters = [text for text in [*typed, *shown] if text not in words]
        assert len(filters) > 20
        for text in filters:
            if text != "controller == pid":  # the page's own example of a mistake
                translate_filter(text)
