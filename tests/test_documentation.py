"""The examples of README.md and docs/ run, and what these pages say of the code is so.

Comments above a block tell how it is run: ``<!-- slow -->`` (by `make test-slow` only), ``<!-- not run: why -->``, ``<!-- file: path -->``
(it is that file, letter by letter), ``<!-- tests add: WORDS -->`` (at the end of each `train`, `bench` and `eval`) and
``<!-- tests replace: A -> B -->``. A document is run from its top, in one folder and one namespace.
"""

import contextlib
import json
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import pytest

from thorndike.cli.main import VERBS, main
from thorndike.config_fields import read_config_fields

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(str(path.relative_to(ROOT)) for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
LANGUAGES = ("python", "bash", "console", "sh")
FENCE = re.compile(r"(?P<indent> *)```(?P<language>\w*)\s*$")
COMMENT = re.compile(r"\s*<!-- (?P<text>.*?) -->\s*$")


class Block(NamedTuple):
    """A fenced block, and the comments above it."""

    document: str
    line: int
    language: str
    text: str
    marks: tuple[str, ...]

    @property
    def where(self):
        return f"{self.document}:{self.line}"

    def told(self, kind):
        """What the comments of one kind say."""
        return [mark.removeprefix(kind).strip() for mark in self.marks if mark.startswith(kind)]

    @property
    def commands(self):
        """The command lines, as the tests run them."""
        text = self.replaced().replace("\\\n", " ")
        lines = [line.strip() for line in text.splitlines()]
        if self.language == "console":
            lines = [line[1:].strip() for line in lines if line.startswith("$")]
        found = [shlex.split(line, comments=True) for line in lines if line and not line.startswith("#")]
        added = [word for words in self.told("tests add:") for word in words.split()]
        return [[*words, *added] if words[1:2] in (["train"], ["bench"], ["eval"]) else words for words in found]

    def replaced(self):
        """The text with what the tests put in for something else; it must have been there."""
        text = self.text
        for told in self.told("tests replace:"):
            before, after = told.split(" -> ")
            assert before in text, f"{self.where}: nothing to replace: {before}"
            text = text.replace(before, after)
        return text


def blocks_of(document):
    lines = (ROOT / document).read_text(encoding="utf-8").splitlines()
    found, opened = [], None
    for number, line in enumerate(lines, start=1):
        fence = FENCE.match(line)
        if opened is None and fence:
            opened = number, len(fence["indent"]), fence["language"]
        elif opened is not None and line.strip() == "```":
            start, indent, language = opened
            text = "\n".join(row[indent:] for row in lines[start : number - 1]) + "\n"
            found.append(Block(document, start, language, text, marks_above(lines, start - 1)))
            opened = None
    assert opened is None, f"{document}: the block of line {opened} is not closed"
    return found


def marks_above(lines, index):
    """The comments right above the line with this index."""
    marks = []
    while index > 0 and (comment := COMMENT.match(lines[index - 1])):
        marks.append(comment["text"])
        index -= 1
    return tuple(reversed(marks))


def examples_of(document, with_slow):
    """The blocks of a document that are to be run."""
    blocks = [block for block in blocks_of(document) if block.language in LANGUAGES and (with_slow or "slow" not in block.marks)]
    return [block for block in blocks if not block.told("not run:") and not block.told("file:")]


WITH_EXAMPLES = [document for document in DOCUMENTS if examples_of(document, with_slow=False)]
WITH_SLOW_EXAMPLES = [document for document in DOCUMENTS if examples_of(document, with_slow=True) != examples_of(document, with_slow=False)]


def run_document(document, folder, monkeypatch, capsys, with_slow):
    """Run the examples in order; returns those that were run to their end."""
    shutil.copytree(ROOT / "examples", folder / "examples")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", list(sys.path))
    # Without a display a film is written in place of a window.
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    namespace, done = {"__name__": "example"}, []
    # A reader's own code need not keep the stricter rule that the library is tested under.
    with jax.numpy_rank_promotion("allow"):
        for block in examples_of(document, with_slow):
            if block.language == "python":
                exec(compile("\n" * block.line + block.replaced(), document, "exec"), namespace)
            else:
                for words in block.commands:
                    run_command(words, block.where, capsys)
            done.append(block)
    sys.modules.pop("own_environment", None)
    return done


def run_command(words, where, capsys):
    capsys.readouterr()
    status = main(words[1:])
    out, err = capsys.readouterr()
    assert status == 0, f"{where}: {shlex.join(words)}: {err}"
    if "--json" in words:
        assert isinstance(json.loads(out), dict)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_block_can_be_run_or_says_why_not(document):
    for block in blocks_of(document):
        if block.language not in LANGUAGES or block.told("file:"):
            continue
        reasons = block.told("not run:")
        assert all(reasons), f"{block.where}: say why it is not run"
        if not reasons and block.language != "python":
            assert block.commands, f"{block.where} has no command"
            strange = [words for words in block.commands if words[0] != "thorndike"]
            assert not strange, f"{block.where}: only thorndike's commands are run; mark the block: <!-- not run: why -->"


@pytest.mark.parametrize("document", WITH_EXAMPLES)
def test_the_examples_of_a_document_run(document, tmp_path, monkeypatch, capsys):
    assert run_document(document, tmp_path, monkeypatch, capsys, with_slow=False) == examples_of(document, with_slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("document", WITH_SLOW_EXAMPLES)
def test_all_examples_of_a_document_run(document, tmp_path, monkeypatch, capsys):
    assert run_document(document, tmp_path, monkeypatch, capsys, with_slow=True) == examples_of(document, with_slow=True)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_a_block_that_shows_a_file_is_that_file(document):
    for block in blocks_of(document):
        for path in block.told("file:"):
            assert block.text == (ROOT / path).read_text(encoding="utf-8"), f"{block.where} is not {path}"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_to_files_and_headings(document):
    text = re.sub(r"```.*?```", "", (ROOT / document).read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("http"):
            continue
        path, _, heading = target.partition("#")
        file = (ROOT / document).parent / path if path else ROOT / document
        assert file.exists(), f"{document}: {target} leads nowhere"
        if heading:
            titles = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
            assert heading in anchors, f"{document}: no heading {target}"


POLICY = ["ppo", "trpo", "a2c", "a3c", "impala", "reinforce"]
VALUE = ["dqn", "rainbow", "qr_dqn", "iqn", "pqn", "bootstrapped_dqn"]
CONTROL = ["sac", "td3", "ddpg", "tqc", "crossq", "redq"]
FROM_DATA = ["bc", "cql", "iql", "td3_bc", "awac"]
GAMES = ["alphazero", "muzero"]


@pytest.mark.parametrize("algorithm", [*POLICY, *VALUE, *CONTROL, *FROM_DATA, *GAMES])
def test_the_table_of_settings_is_that_of_the_code(algorithm):
    text = (ROOT / f"docs/algorithms/{algorithm}.md").read_text(encoding="utf-8")
    section = text.partition("## Settings")[2].partition("\n## ")[0]
    told = re.findall(r"^\| `(\w+)` \| `([^`]*)` \|", section, flags=re.MULTILINE)
    fields = read_config_fields(algorithm)
    assert told == [(name, str(facts.default).strip('"')) for name, facts in fields.items() if name != "total_steps"]


@pytest.mark.parametrize("verb", VERBS)
def test_the_page_of_the_command_line_has_every_flag(verb, capsys):
    text = (ROOT / "docs/command_line.md").read_text(encoding="utf-8")
    section = text.partition(f"\n## {verb}\n")[2].partition("\n## ")[0]
    with contextlib.suppress(SystemExit):
        main([verb, "--help"])
    options = capsys.readouterr().out.partition("options:")[2].partition("examples:")[0]
    flags = set(re.findall(r"^  (?:-h, )?(--[a-z-]+)", options, flags=re.MULTILINE)) - {"--help"}
    table = set(re.findall(r"--[a-z][a-z-]*", "\n".join(re.findall(r"^\|(.*?)\|", section, flags=re.MULTILINE))))
    assert flags == table if verb != "info" else flags == {"--json"}


def test_the_page_of_concepts_quotes_lines_that_exist():
    text = (ROOT / "docs/concepts.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|.*\]\(\.\./(src/[^)]+)\) \| `(.+)` \|$", text, flags=re.MULTILINE)
    assert len(rows) > 20
    for path, line in rows:
        assert line.replace("\\|", "|") in (ROOT / path).read_text(encoding="utf-8"), f"{path} has no line {line}"
