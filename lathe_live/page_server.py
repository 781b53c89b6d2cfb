# SPDX-License-Identifier: Apache-2.0
"""Server of pages for a person at this machine: pages, and JSON answers to their scripts, on the loopback interface.

The address contains a random token, which each request must repeat, so that other users of the machine and other pages
in the browser get nothing. Requests with a foreign ``Host`` are refused, since a name of a foreign site may resolve to
this machine (DNS rebinding), and so are those with a foreign ``Origin``. Pages load nothing: styles and scripts are
part of them, and the browser allows no others.
"""

import asyncio
import contextlib
import json
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from lathe_rc.drawing.pages import own_file
from lathe_rc.errors import InputError, LatheError, correctable, shown

HOST = "127.0.0.1"  #: the only interface
TOKEN = "X-Lathe-Token"  # noqa: S105 - the header with the token, which the scripts of a page send
_LARGEST = 2**20  # request [B]
_LONGEST = 400  # error [characters]
_DIGITS = 300  # digits of an integer from which on it counts as infinite
_LOOSE = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}


@dataclass(frozen=True)
class Page:
    """Page of a site; `page_server.js` and page.css are part of each.

    Attributes:
        title: title, also the text of its tab.
        body: HTML of the content; other people's text in it must be escaped.
        styles: further style sheets.
        scripts: scripts, run in this order after the content is there.
    """

    title: str
    body: str
    styles: Sequence[str] = ()
    scripts: Sequence[str] = ()


Answer = Callable[[Mapping[str, Any]], object]  #: answer to a question of a page: JSON data


@dataclass(frozen=True)
class Site:
    """Pages that are served together, with tabs between them.

    Attributes:
        pages: pages by path; the first one has the empty path.
        answers: answers by name, for ``ask(name, question)`` of page_server.js; they are called by several threads. A
            `LatheError` is shown in the page.
    """

    pages: Mapping[str, Page]
    answers: Mapping[str, Answer] = field(default_factory=dict)


def _document(site: Site, path: str, token: str, nonce: str) -> str:
    """Return a page as HTML."""
    page = site.pages[path]
    tabs = [
        f'<a href="/{other}?token={token}"{" aria-current=page" if other == path else ""}>{escape(told.title)}</a>'
        for other, told in site.pages.items()
    ]
    styles = "\n".join([own_file("page.css"), *page.styles])
    scripts = [own_file("page_server.js", Path(__file__).parent), *page.scripts]
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">',
            f'<title>{escape(page.title)}</title>\n<style nonce="{nonce}">{styles}</style></head>\n<body>',
            f"<nav>{' '.join(tabs)}</nav>" if len(tabs) > 1 else "",
            page.body,
            *(f'<script nonce="{nonce}">{script}</script>' for script in scripts),
            "</body></html>",
        ]
    )


def _application(site: Site, port: int, token: str) -> Starlette:
    """Return the application that answers requests at a port."""
    hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    def refused(request: Request, given: str) -> Response | None:
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if host not in hosts or origin not in (None, f"http://{host}"):
            return PlainTextResponse(f"allowed: requests of http://{HOST}:{port}", 403)
        if not secrets.compare_digest(given.encode(), token.encode()):
            return PlainTextResponse("wrong or no token: open the address that lathe printed", 403)
        return None

    async def shown(request: Request) -> Response:
        path, nonce = request.path_params["path"], secrets.token_urlsafe(16)
        if refusal := refused(request, request.query_params.get("token", "")):
            return refusal
        if path not in site.pages:
            return PlainTextResponse("no such page", 404)
        policy = f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
        policy += "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        return HTMLResponse(_document(site, path, token, nonce), headers={**_LOOSE, "Content-Security-Policy": policy})

    async def answered(request: Request) -> Response:
        if refusal := refused(request, request.headers.get(TOKEN, "")):
            return refusal
        answer = site.answers.get(request.path_params["name"])
        if answer is None:
            return JSONResponse({"error": "no such question"}, 404)
        return await _told(answer, request)

    return Starlette(
        routes=[Route("/ask/{name:path}", answered, methods=["POST"]), Route("/{path:path}", shown, methods=["GET"])]
    )


async def _told(answer: Answer, request: Request) -> Response:
    """Return the response to a question."""
    try:
        found = await run_in_threadpool(answer, await _question(request))
    except (LatheError, OSError) as error:
        told = correctable(error)
        return JSONResponse({"error": shown(told, _LONGEST)}, 400 if isinstance(told, InputError) else 500)
    return JSONResponse(found, headers=_LOOSE)


async def _question(request: Request) -> Mapping[str, Any]:
    """Return the data that a script has sent.

    Raises:
        InputError: they are too large, or no JSON object.
    """
    body = bytearray()
    with contextlib.suppress(ClientDisconnect):
        async for part in request.stream():
            body += part
            if len(body) > _LARGEST:
                raise InputError(f"question of more than {_LARGEST} B; allowed: a smaller one")
    try:
        # An integer beyond all numbers is refused as infinity by the one that asks for a number.
        found = json.loads(body or b"{}", parse_int=lambda digits: (int if len(digits) < _DIGITS else float)(digits))
        json.dumps(found, ensure_ascii=False).encode()  # refuses half a character
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or b"\\u0000" in body:
        raise InputError("a question that is no JSON object of numbers and texts without NUL; allowed: such an object")
    return found


@contextlib.contextmanager
def serving(site: Site, port: int = 0) -> Iterator[str]:
    """Serve a site from a thread of its own while the block runs.

    Args:
        site: the pages.
        port: TCP port; 0: a free one.

    Yields:
        The address of the first page, with the token.

    Raises:
        InputError: the port is in use, or may not be used.
    """
    try:
        listener = socket.create_server((HOST, port))
    except OSError as error:
        why = os.strerror(error.errno or 0)
        raise InputError(f"--port {port}: {why}; allowed: another port, or 0 for a free one") from None
    token, port = secrets.token_urlsafe(24), listener.getsockname()[1]
    config = uvicorn.Config(
        _application(site, port, token),
        log_level="error",
        access_log=False,
        lifespan="off",
        ws="none",
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])), name="page server")
    thread.start()
    try:
        yield f"http://{HOST}:{port}/?token={token}"
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def open_browser(address: str) -> None:
    """Open an address in the user's browser, if there is a display; browsers in a terminal would hide the address."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(address)


def announce(address: str, say: Callable[[str], object], *, browser: bool) -> None:
    """Tell the user the address of a page, and open it in the browser if asked to."""
    say(f"page: {address} (Ctrl-C ends it)")
    if browser:
        open_browser(address)


def serve(site: Site, port: int, say: Callable[[str], object], *, browser: bool) -> None:
    """Serve a site until Ctrl-C or SIGTERM.

    Args:
        site: the pages.
        port: TCP port; 0: a free one.
        say: called with the line for the user.
        browser: whether to open the page in the browser.

    Raises:
        InputError: see `serving`.
    """
    with contextlib.suppress(KeyboardInterrupt), serving(site, port) as address:
        announce(address, say, browser=browser)
        threading.Event().wait()
