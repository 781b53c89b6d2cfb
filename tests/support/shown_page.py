# SPDX-License-Identifier: Apache-2.0
"""A page of lathe_rc as a browser reads it."""

import base64
import json
import re
import zlib
from hashlib import sha256
from html.parser import HTMLParser

_KNOWN = ("style", "script", "h2", "td", "noscript")


class ShownPage(HTMLParser):
    """Elements, texts, tables by the heading above them, figures and scripts of a page.

    Args:
        source: of the page.
    """

    def __init__(self, source):
        super().__init__()
        self.source, self.text, self.policy, self._heading, self._inside = source, "", "", "", ""
        self.tags, self.links, self.ids, self.scripts, self.tables = [], [], [], [], {}
        self.feed(source)
        self.text = " ".join(self.text.split())
        found = json.loads(zlib.decompress(base64.b64decode(self.scripts[0]))) if self.scripts else {}
        self.specs, self.data = found.get("specs", {}), found.get("data", {})

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.tags.append(tag)
        self.ids += [given["id"]] if "id" in given else []
        self.links += [value for name, value in attributes if name in ("src", "href", "srcset", "action")]
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given["content"]
        self._inside = tag if tag in _KNOWN else self._inside
        if tag == "script":
            self.scripts.append("")
        elif tag == "h2":
            self._heading = ""
        elif tag == "tr":
            self.tables.setdefault(self._heading, []).append([])
        elif tag == "td":
            self.tables[self._heading][-1].append("")

    def handle_endtag(self, tag):
        self._inside = "" if tag == self._inside else self._inside

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside not in ("style", "noscript"):
            self.text += data
        if self._inside == "h2":
            self._heading += data
        elif self._inside == "td":
            self.tables[self._heading][-1][-1] += data

    @property
    def cells(self):
        return [cell for rows in self.tables.values() for row in rows for cell in row]

    def rows(self, heading):
        """Of the table under a heading, without its head."""
        return [row for row in self.tables[heading] if row]

    def may_run(self):
        """The scripts that the page allows itself."""
        hashes = set(re.findall(r"'sha256-([^']+)'", self.policy))
        return [text for text in self.scripts if base64.b64encode(sha256(text.encode()).digest()).decode() in hashes]
