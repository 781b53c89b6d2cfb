# SPDX-License-Identifier: Apache-2.0
"""The seal of a bag: a verdict rests on what was recorded, and a change since then is named."""

import shutil
from base64 import b64encode
from random import Random

import pytest
import sealed_bags
from bags import QOS, lathe
from sealed_bags import retold

import lathe_rc
from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.loss import HELD
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.writing.writer import BagWriter
from lathe_rc.errors import InputError


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag in three files, of a part with a tolerance and a form from a file."""
    return sealed_bags.made(tmp_path_factory.mktemp("recorded") / "bag")


@pytest.fixture
def bag(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "bag")


def replace(file, *pairs):
    """Other bytes of the same or another length, each in place of its first occurrence."""
    data = file.read_bytes()
    for old, new in pairs:
        assert old in data
        data = data.replace(old, new, 1)
    file.write_bytes(data)


def metadata(*pairs):
    """A change to metadata.yaml."""
    return lambda bag: replace(bag / "metadata.yaml", *pairs)


def swap(bag):
    """Exchange two files."""
    (bag / "bag_1.mcap").rename(bag / "other")
    (bag / "bag.mcap").rename(bag / "bag_1.mcap")
    (bag / "other").rename(bag / "bag.mcap")


def other_run(name):
    """A file of another run in place of the bag's."""

    def change(bag):
        shutil.copy(
            sealed_bags.made(bag.with_name("again") / "bag", learning_controller={"learning_gain": 0.5}) / name, bag
        )

    return change


def sealed_record(bag):
    """A same-length edit of the sealed metadata inside the last file."""
    replace(bag / "bag_2.mcap", (b'"storage_identifier": "mcap"', b'"storage_identifier": "mcaq"'))


def held(bag):
    """No word of a held range."""
    retold(bag, lambda about: about.update({HELD: '{"/tool": 5}'}))
    file = bag / "metadata.yaml"
    file.write_text("".join(line for line in file.open() if HELD not in line))


def digits(indent):
    """One digit more in the first count that is indented like this."""
    return metadata((b'\n%s"message_count": ' % indent, b'\n%s"message_count": 1' % indent))


def base64(form):
    return b64encode(form.encode())


RADII = sealed_bags.FORM.replace("30", "31").replace("-10", "-11")
CHANGES = {
    "tolerance": (
        metadata((b"tolerance: 2.0e-06", b"tolerance: 9.0e-04")),
        "metadata.yaml: custom_data.lathe_rc.scenario is '    tolerance: 9.0e-04', sealed: '    tolerance: 2.0e-06'",
    ),
    "two radii": (
        metadata((base64(sealed_bags.FORM), base64(RADII))),
        "metadata.yaml: custom_data.lathe_rc.file.tool.profile_file is 'YW",
    ),
    "held range": (held, "metadata.yaml: custom_data.lathe_rc.held is missing, sealed: '{\"/tool\": 5}'"),
    "count in all": (digits(b"  "), "metadata.yaml: message_count is '1"),
    "count of a file": (digits(b"    "), "metadata.yaml: files[0].message_count is '1"),
    "count of a topic": (digits(b"  - "), "metadata.yaml: topics_with_message_count[0].message_count is '1"),
    "a line gone": (
        metadata((b'  "storage_identifier": "mcap"\n', b"")),
        "metadata.yaml: storage_identifier is missing, sealed: 'mcap'",
    ),
    "a line more": (
        metadata((b'  "version"', b'  "versions": 9\n  "version"')),
        "metadata.yaml: versions is '9', sealed: missing",
    ),
    "swapped files": (swap, "bag.mcap is not the file that was sealed under this name"),
    "file of another run": (other_run("bag_1.mcap"), "bag_1.mcap is not the file that was sealed under this name"),
    "last file of another run": (other_run("bag_2.mcap"), "metadata.yaml: custom_data.lathe_rc."),
    "metadata of another run": (other_run("metadata.yaml"), "metadata.yaml: custom_data.lathe_rc."),
    "sealed metadata": (sealed_record, "bag_2.mcap has no seal that holds: "),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_since_the_recording_is_named_and_its_bag_refused(bag, change):
    """`check` lists all changes, `info` ends with code 3, and other readers refuse the bag."""
    make, said = CHANGES[change]
    make(bag)
    checked = lathe("bag", "check", bag)
    assert (checked.exit_code, said in checked.stdout) == (1, True), checked.output
    assert lathe("bag", "info", bag).exit_code == 3
    with pytest.raises(InputError, match="; lathe bag check tells all, lathe bag recover makes a sealed bag"):
        lathe_rc.read_bag(bag)


READERS = ("measure", "report -o {0}.html", "resim", "compare -o {0}.html {1}", "export --csv -o {0}", "bag tachogram")


@pytest.mark.parametrize("words", [*READERS, "replay", "correct --scenario piston -o {0}.csv"])
def test_every_reader_refuses_a_changed_bag_with_one_line(bag, recorded, words, monkeypatch):
    monkeypatch.chdir(bag.parent)
    CHANGES["tolerance"][0](bag)
    found = lathe(*words.format("new", recorded).split(), bag)
    assert (found.exit_code, found.stderr.count("\n")) == (2, 1), found.output
    assert CHANGES["tolerance"][1] in found.stderr
    assert [path.name for path in bag.parent.iterdir()] == ["bag"]


def test_no_single_change_beside_the_data_changes_a_verdict_in_silence(bag):
    """Some bits, digits and lines of metadata.yaml, digests.json and the records; tests/system makes hundreds."""
    sealed_bags.assert_none_is_silent(bag, 3, Random(20), ("bag", "check"), ("measure",))  # noqa: S311


def test_digests_of_another_run_are_another_verdict(bag):
    other_run("digests.json")(bag)
    assert [lathe(*words, bag).exit_code for words in (("bag", "check"), ("resim",))] == [1, 1]


def test_without_metadata_the_sealed_copy_counts(bag):
    """Each figure is as before, and `check` names what is missing."""
    before = sealed_bags.verdicts(bag, [("bag", "info")])
    (bag / "metadata.yaml").unlink()
    assert sealed_bags.verdicts(bag, [("bag", "info")]) == before
    checked = lathe("bag", "check", bag)
    assert (checked.exit_code, "no metadata.yaml in that folder" in checked.stdout) == (1, True)


def test_what_says_the_same_in_other_words_is_no_change(bag):
    file = bag / "metadata.yaml"
    file.write_text(f"# a comment\n{file.read_text()}\n")
    assert lathe("bag", "check", bag).exit_code == 0


def test_a_bag_of_an_earlier_version_has_no_seal_and_is_named(bag):
    """`recover` makes a sealed copy, which says so."""
    with sealed_bags.unsealed():
        old = sealed_bags.made(bag.with_name("old"))
    with pytest.raises(InputError, match=r"old.mcap has no seal that holds: .* an earlier version"):
        BagSource(old)
    assert lathe("bag", "recover", old, "-o", bag.with_name("new")).exit_code == 0
    with BagSource(bag.with_name("new")) as source:
        assert source.about[provenance.RECOVERED].endswith("; from a bag without a seal that holds")


# ---- bags of bags


def told(bag):
    """The seal and the strings of a bag."""
    with BagSource(bag) as source:
        return str(source.seal), source.about


def test_a_recovered_or_copied_bag_has_a_seal_of_its_own_and_names_the_one_of_its_origin(bag, tmp_path):
    """Also after the next copy, with losses that an earlier one told."""
    lines = {}
    for number, words in enumerate((("recover",), ("recover",), ("copy", "--topics", "/tool"))):
        new = tmp_path / f"new{number}"
        assert lathe("bag", *words, bag, "-o", new).exit_code == 0
        (before, _), (after, about) = told(bag), told(new)
        assert before != after
        lines[number], bag = "\n".join(provenance.origin(about)), new
        assert f"the bag with seal {before}" in lines[number]
    assert lines[1].count("seal") == 2
    assert lines[2].count("seal") == 3
    assert all(line in lathe("bag", "check", bag).stdout for line in lines[2].splitlines())


def test_recover_makes_a_bag_of_what_was_sealed(bag, recorded, tmp_path):
    """Neither an edit of metadata.yaml nor one of the scenario in the file gets into the new bag."""
    CHANGES["tolerance"][0](bag)
    data = (bag / "bag.mcap").read_bytes()
    replace(bag / "bag.mcap", (b"tolerance: 2.0e-06", b"tolerance: 9.0e-04"))
    assert data != (bag / "bag.mcap").read_bytes()
    found = lathe("bag", "recover", bag, "-o", tmp_path / "new")
    assert CHANGES["tolerance"][1] in found.stdout
    assert told(tmp_path / "new")[1][provenance.SCENARIO] == told(recorded)[1][provenance.SCENARIO]


def test_a_copy_of_a_bag_with_a_file_of_another_run_says_so(bag, tmp_path):
    other_run("bag_1.mcap")(bag)
    for words in (("copy",), ("recover",)):
        found = lathe("bag", *words, bag, "-o", tmp_path / words[0])
        assert (found.exit_code, "bag_1.mcap is not the file that was sealed" in found.stdout) == (3, True), (
            found.output
        )
        assert ", of which files were exchanged" in "".join(provenance.origin(told(tmp_path / words[0])[1]))


def test_a_recording_that_was_never_closed_has_no_seal(tmp_path):
    """A kill loses what the last file learned on the way; `recover` says so, and keeps what that file was told."""
    writer = BagWriter(tmp_path / "bag", compression="none", chunk_size=2**16, about={"one": "1"})
    writer.add_topic("/said", messages.EVENT, QOS)
    writer.split_ns = 1000
    for stamp in (0, 2000):
        writer.write("/said", stamp, bytes(50))
        writer.flush()
    writer.tell({"two": "2"})
    writer.abort()
    found = lathe("bag", "info", tmp_path / "bag")
    assert (found.exit_code, "bag_1.mcap has no seal that holds: " in found.stderr) == (3, True), found.output
    lathe("bag", "recover", tmp_path / "bag", "-o", tmp_path / "new")
    about = told(tmp_path / "new")[1]
    assert (about["one"], about["two"]) == ("1", "2")
    assert about[provenance.RECOVERED].endswith("; from a bag without a seal that holds")
