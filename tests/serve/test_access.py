"""Who is let in: a browser on this machine with the token, which may only read."""

import socket
from http.cookies import SimpleCookie

import pytest

from tests.serve.conftest import Served
from trms_cli.core.errors import ConfigurationError
from trms_cli.library.server.application import listening_socket

PAGES = ("/", "/compare", "/run/0", "/folder/0", "/assets/page.js", "/nothing")


@pytest.mark.parametrize("path", [*PAGES, "/?token=", "/?token=guess"])
def test_without_the_token_nothing_is_shown(served: Served, path: str) -> None:
    answer = served.ask(path, cookie=False)
    assert answer.status == 403 and "set-cookie" not in answer.headers
    assert "trms serve" in answer.text and "sweep" not in answer.text


def test_the_token_is_exchanged_for_a_cookie_that_no_script_and_no_other_site_has(
    served: Served,
) -> None:
    entrance = served.ask(served.address.partition(str(served.port))[2], cookie=False)
    assert (entrance.status, entrance.headers["location"]) == (303, "/")
    (cookie,) = SimpleCookie(entrance.headers["set-cookie"]).values()
    assert cookie["httponly"] and cookie["samesite"].lower() == "strict" and cookie["path"] == "/"
    token = served.address.partition("token=")[2]
    assert len(token) >= 40 and token not in cookie.value  # a history's token is no cookie
    assert served.ask("/").status == 200
    for wrong in (f"{cookie.key}={cookie.value[:-1]}", f"{cookie.key}=", "x", "\x01=;;", "é=ü"):
        assert served.ask("/", cookie=False, Cookie=wrong).status == 403


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:{}",
        "127.0.0.1",
        "127.0.0.1:1",
        "127.0.0.1:{}.evil.example",
        "",
    ],
)
def test_a_name_that_leads_here_is_refused(served: Served, host: str) -> None:
    answer = served.ask("/", Host=host.format(served.port))
    assert answer.status == 421 and "sweep" not in answer.text
    entrance = served.address.partition(str(served.port))[2]
    assert "set-cookie" not in served.ask(entrance, Host=host.format(served.port)).headers


def test_this_machine_may_call_itself_localhost(served: Served) -> None:
    assert served.ask("/", Host=f"localhost:{served.port}").status == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "FROB"])
@pytest.mark.parametrize("path", ["/", "/compare", "/nothing"])
def test_nothing_but_reading(served: Served, method: str, path: str) -> None:
    assert served.ask(path, method).status in (400, 405)


def test_a_head_has_the_headers_alone(served: Served) -> None:
    answer = served.ask("/", "HEAD")
    assert (answer.status, answer.text) == (200, "") and int(answer.headers["content-length"]) > 999


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd",
        "/assets/../../../etc/passwd",
        "/assets/..%2f..%2f..%2fetc%2fpasswd",
        "/assets/%2e%2e/%2e%2e/etc/passwd",
        "/run/..%2f..%2fpid%2frun.mcap",
        "/run//etc/passwd",
        "/folder/%2f",
        "/folder/..",
        "/compare?run=/etc/passwd&run=../pid",
        "/run/%00",
        "//etc/passwd",
        "/run/" + 9000 * "x",
    ],
)
def test_no_address_names_a_file(served: Served, path: str) -> None:
    answer = served.ask(path)
    assert answer.status in (400, 404) and "root:" not in answer.text


def test_runs_beside_the_folder_are_not_served(serving, served: Served) -> None:
    part = serving(served.folder / "sweep")
    inside, outside = served.key("sweep/3"), served.key("pid")
    assert part.ask(f"/run/{inside}").status == 200
    for path in (f"/run/{outside}", f"/compare?run={inside}&run={outside}"):
        answer = part.ask(path)
        assert answer.status == 404 and "no such run" in answer.text


def test_every_answer_forbids_what_no_page_needs(served: Served) -> None:
    key = served.key("pid")
    asset = served.ask("/").text.partition('<script src="')[2].partition('"')[0]
    for path, cookie in ((f"/run/{key}", True), ("/", True), ("/nothing", True), ("/", False),
                         (asset, True), ("/compare?run=x", True)):  # fmt: skip
        headers = served.ask(path, cookie=cookie).headers
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; ")
        assert "frame-ancestors 'none'" in policy and "unsafe-eval" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        stored = "immutable" if path == asset else "no-store"
        assert stored in headers["cache-control"]


def test_only_the_loopback_address_listens(served: Served) -> None:
    for other in ("127.0.0.2", socket.gethostbyname(socket.gethostname())):
        if other != "127.0.0.1":
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((other, served.port), timeout=2)


def test_a_port_that_is_in_use_is_told(served: Served) -> None:
    with pytest.raises(ConfigurationError, match=f"port {served.port} cannot be had"):
        listening_socket(served.port).__enter__()


def test_nothing_is_written_beside_the_runs(served: Served) -> None:
    def there() -> set[tuple[str, int]]:
        return {(str(p), p.stat().st_mtime_ns) for p in served.folder.rglob("*")}

    before = there()
    for path in ("/", f"/run/{served.key('pid')}", "/?filter=rmse_yaw<1"):
        assert served.ask(path).status == 200
    assert there() == before
