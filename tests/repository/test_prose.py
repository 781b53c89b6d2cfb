# SPDX-License-Identifier: Apache-2.0
"""The list of refused constructions: each rule finds its example, and not the better words."""

import pytest

import prose

RULES = prose.rules()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.before)
def test_a_rule_refuses_its_example_and_nothing_refuses_the_better_words(rule):
    assert rule.pattern.search(rule.before)
    assert [other.why for other in RULES if other.pattern.search(rule.after)] == []


def test_pages_docstrings_comments_and_messages_are_read_but_no_code(tmp_path):
    """A hit is named with its line; code in pages may say anything, and so may names in Python."""
    (refused,) = (rule.before for rule in RULES if "bridge" in rule.before)
    broken = refused.replace(" ", "\n")
    page, module = tmp_path / "page.md", tmp_path / "module.py"
    page.write_text(f"Plain.\n\n```console\n{refused}\n```\n\n`{refused}`\n{broken}\n")
    module.write_text(f'"""First.\n\n{broken}"""\n{refused.split()[2]} = f"{{1}} {refused}"  # {refused}\n')
    named = [line.rsplit("/", 1)[1] for path in (page, module) for line in prose.found(path, RULES)]
    assert [line.partition(": ")[0] for line in named] == ["page.md:10", "module.py:5", "module.py:8", "module.py:8"]


def test_a_module_is_named_after_its_content(tmp_path):
    (tmp_path / "story.py").touch()
    (tmp_path / "provenance.py").touch()
    assert len(list(prose.found(tmp_path / "story.py", RULES))) == 1
    assert list(prose.found(tmp_path / "provenance.py", RULES)) == []
