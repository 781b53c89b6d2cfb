# SPDX-License-Identifier: Apache-2.0
"""Pages on the loopback interface: who gets them, and who does not."""

import http.client
import json
import re
import socket
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from lathe_live import page_server
from lathe_live.page_server import Page, Site
from lathe_rc.errors import InputError


def refuse(question):
    raise InputError(f"gain = {question['gain']}; allowed: less")


SITE = Site(
    {"": Page("cell <1>", "<p>content</p>", scripts=["const A = 1;"]), "loop": Page("loop", "")},
    {
        "twice": lambda question: {"found": 2 * question["value"]},
        "refuse": refuse,
        "file": lambda question: {"found": Path(question["name"]).exists()},
    },
)


@pytest.fixture(scope="module")
def address():
    with page_server.serving(SITE) as found:
        yield urlsplit(found)


def get(address, path=None, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=10)
    connection.request(method, path or f"/?{address.query}", body, {k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    return answer.status, answer.read().decode(), answer.headers


def ask(address, name, question, **headers):
    token = {page_server.TOKEN: address.query.partition("=")[2], **headers}
    return get(
        address, f"/ask/{name}", "POST", question if isinstance(question, str) else json.dumps(question), **token
    )


def test_a_page_contains_all_that_it_needs_and_the_browser_allows_nothing_else(address):
    status, page, headers = get(address)
    assert status == 200
    assert "<title>cell &lt;1&gt;</title>" in page
    assert f'<a href="/loop?{address.query}">loop</a>' in page
    policy = headers["Content-Security-Policy"]
    nonces = set(re.findall(r'nonce="(.*?)"', page))
    assert nonces == set(re.findall(r"'nonce-(.*?)'", policy))
    assert "default-src 'none'" in policy
    assert get(address)[2]["Content-Security-Policy"] != policy  # a new nonce each time
    assert get(address, f"/other?{address.query}")[0] == 404


def test_answers_are_data_and_refusals(address):
    assert ask(address, "twice", {"value": 21})[:2] == (200, '{"found":42}')
    assert ask(address, "refuse", {"gain": 3})[:2] == (400, '{"error":"gain = 3; allowed: less"}')
    assert ask(address, "refuse", {"gain": "x" * 5000})[:2] == (400, f'{{"error":"gain = {"x" * 393}"}}')
    assert ask(address, "file", {"name": "x" * 5000})[0] == 400
    assert ask(address, "file", {"name": "9" * 5000})[0] == 400
    assert ask(address, "refuse", f'{{"gain": {"9" * 4000}}}')[:2] == (400, '{"error":"gain = inf; allowed: less"}')
    assert ask(address, "nothing", {})[0] == 404


@pytest.mark.parametrize(
    "question", ["[1]", "{", "[" * 100_000, "x" * (2**20 + 1), '{"value": "\\u0000"}', '{"value": "\\ud800"}']
)
def test_a_question_that_is_no_object_is_refused(address, question):
    assert ask(address, "twice", question)[0] == 400


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "lathe.example"},
        {"Host": "127.0.0.1:1"},
        {"Origin": "http://lathe.example"},
        {"Origin": "null"},
        {page_server.TOKEN: "guessed"},
        {page_server.TOKEN: "é"},
    ],
    ids=str,
)
def test_foreign_pages_and_guessed_tokens_are_refused(address, headers):
    """A page of another site gets nothing, even if its name resolves to this machine."""
    assert ask(address, "twice", {"value": 1}, **headers)[0] == 403


def test_a_page_without_its_token_is_refused(address):
    assert get(address, "/")[0] == 403
    assert get(address, f"/?{address.query}x")[0] == 403
    assert get(address, Host="lathe.example")[0] == 403


def test_only_this_machine_is_served(address):
    assert address.hostname == "127.0.0.1"
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", address.port), timeout=5)


def test_a_port_in_use_is_refused(address):
    with pytest.raises(InputError, match=rf"--port {address.port}: Address already in use; allowed: another port"):
        page_server.serving(SITE, address.port).__enter__()


def test_an_interrupt_ends_the_server():
    said = []

    def interrupted(line):
        said.append(line)
        raise KeyboardInterrupt

    page_server.serve(SITE, 0, interrupted, browser=False)
    found = urlsplit(re.search(r"http://\S+", said[0])[0])
    with pytest.raises(OSError, match="refused"):
        get(found)
