"""Checks of requests before the page's server receives them.

Gradio fetches addresses that a client names as files, and proxies them; it reads uploads of any announced size up to
its limit. A viewer needs neither. Requests that name another host come from scripts of other sites in the user's
browser, whose host name was resolved to this machine (DNS rebinding).
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import unquote

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

#: Bytes of the largest message that is no upload.
MAX_JSON = 1 << 20
#: Bytes around the file in an upload.
_AROUND = 1 << 16
#: Names of this machine.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: Beginnings of the paths of Gradio that the page uses; "/" is the page itself.
READ = (
    *("/assets/", "/static/", "/svelte/", "/theme.css", "/config", "/favicon.ico", "/manifest.json", "/heartbeat/"),
    *("/queue/data", "/file=", "/upload_progress", "/startup-events", "/app_id"),
)
SENT = ("/queue/join", "/run/", "/upload", "/cancel", "/reset")


class Guard:
    """ASGI middleware that answers 403 and 413; ``hosts``: allowed host names, None for any."""

    def __init__(self, app: App, hosts: tuple[str, ...] | None, most_bytes: int) -> None:
        self._app, self._hosts, self._most_bytes = app, hosts, most_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check and pass on one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        path = unquote(scope["path"]).removeprefix("/gradio_api")
        if (refused := self._refusal(headers, scope["method"], path)) is not None:
            await _answer(send, *refused)
        elif scope["method"] == "POST" and not path.startswith("/upload"):
            await self._pass_message(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _refusal(self, headers: dict[str, str], verb: str, path: str) -> tuple[int, str] | None:
        """Status and text if the headers alone require a refusal."""
        if self._hosts is not None and host_name(headers.get("host", "")) not in self._hosts:
            return 403, "expected a request to this machine by its own name"
        used = {"POST": SENT, "GET": READ, "HEAD": READ}.get(verb, ())
        if not (path.startswith(used) or (path == "/" and used is READ)) or ":/" in path:
            return 403, "expected a part of the viewer"
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > self._most_bytes + _AROUND:
            return 413, f"expected a file of at most {self._most_bytes / 2**20:.0f} MB"
        return None

    async def _pass_message(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Read a complete message, and pass it on unless it names files elsewhere."""
        body = b""
        more = True
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body += message.get("body", b"")
            more = message.get("more_body", False)
            if len(body) > MAX_JSON:
                await _answer(send, 413, f"expected a message of at most {MAX_JSON} bytes")
                return
        if names_address(body):
            await _answer(send, 403, "expected files that were uploaded, found an address")
            return
        passed = False

        async def replay() -> Message:
            nonlocal passed
            if passed:
                return await receive()
            passed = True
            return {"type": "http.request", "body": body, "more_body": False}

        await self._app(scope, replay, send)


def host_name(host: str) -> str:
    """The name in a Host header, in small letters, without port and brackets."""
    host = host.lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.rpartition(":")[0] if ":" in host else host


def names_address(body: bytes) -> bool:
    """True if a JSON message has a file whose path is an address, which Gradio would fetch."""
    try:
        waiting: list[Any] = [json.loads(body)] if body else []
    except (ValueError, RecursionError):
        return False
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            if "://" in str(value.get("path", "")):
                return True
            waiting.extend(value.values())
        elif isinstance(value, list):
            waiting.extend(value)
    return False


async def _answer(send: Send, status: int, text: str) -> None:
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": text.encode()})
