"""Who may ask a server of pages: a browser on this machine that was given the address with a token.

Other people's pages in the same browser, other users of the machine, and names that lead to
127.0.0.1 (DNS rebinding) get nothing: an answer needs the ``Host`` that was opened, a method that
only reads, and a cookie that only the address with the token gives. The cookie stays out of
scripts' reach and out of what other sites cause (``HttpOnly``, ``SameSite=Strict``).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import parse_qs

from starlette.responses import PlainTextResponse, RedirectResponse, Response

from trms_cli.reporting.page import HOSTED_POLICY

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: The address that a server of pages has.
LOOPBACK = "127.0.0.1"
#: Headers of every answer.
HEADERS = {
    "content-security-policy": HOSTED_POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
}
_NO_STORE = "no-store"


def new_token() -> str:
    """A secret that nobody guesses: 256 bits, as text for an address."""
    return secrets.token_urlsafe(32)


class Guard:
    """Lets requests through to an application that may see its pages.

    Parameters
    ----------
    application : ASGI application
    port : int
    """

    def __init__(self, application: ASGIApp, port: int) -> None:
        self._application = application
        self._token = new_token()
        #: What lets a browser in: the first address, with the token.
        self.address = f"http://{LOOPBACK}:{port}/?token={self._token}"
        self._session = new_token()  # the address may stay in a history, the cookie does not
        self._hosts = {f"{LOOPBACK}:{port}", f"localhost:{port}"}
        # Cookies of one host are shared by its ports: each server has a name of its own.
        self.cookie = f"trms-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or have the application answer."""
        if scope["type"] != "http":  # no web socket; a server of pages has no start and no end
            return
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = {name.lower() for name, _ in message["headers"]}
                more = HEADERS | {"cache-control": _NO_STORE}
                message["headers"] = [
                    *message["headers"],
                    *((k.encode(), v.encode()) for k, v in more.items() if k.encode() not in own),
                ]
            await send(message)

        refusal = self._refusal(scope, headers)
        answering = self._application if refusal is None else refusal
        await answering(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope, headers: Mapping[str, str]) -> Response | None:
        """The answer to a request that the application does not see."""
        if headers.get("host", "").lower() not in self._hosts:
            return PlainTextResponse("This server has another name.\n", 421)
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse(
                "Nothing can be written here.\n", 405, headers={"allow": "GET, HEAD"}
            )
        query = parse_qs(scope["query_string"].decode("latin-1"))
        for token in query.get("token", [])[:1]:
            if hmac.compare_digest(token.encode(), self._token.encode()):
                answer = RedirectResponse("/", 303)
                answer.set_cookie(
                    self.cookie, self._session, path="/", httponly=True, samesite="strict"
                )
                return answer
        if not self._is_known(headers.get("cookie", "")):
            return PlainTextResponse(
                "Open the address that `trms serve` shows in its terminal: "
                "it has the token that lets a browser in.\n",
                403,
            )
        return None

    def _is_known(self, header: str) -> bool:
        try:
            cookie = SimpleCookie(header).get(self.cookie)
        except CookieError:
            return False
        return cookie is not None and hmac.compare_digest(
            cookie.value.encode(), self._session.encode()
        )
