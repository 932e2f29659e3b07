"""README and docs do what they say.

Per page: its Python blocks run in order in one namespace; a block that begins with `# mine.py` is that file for the
commands below it. Every `covis` command, in blocks and in running text, is parsed as the command line would parse it:
unknown subcommands, options, methods, targets and areas fail. Commands in blocks that take seconds are run, on small
stand-ins for the scenes and datasets they name. Other programs are listed in EXEMPT, with the reason.
"""

import json
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer
from markdown_it import MarkdownIt
from typer.testing import CliRunner

from covis.evaluation.methods import Method
from covis.evaluation.settings import SCENE_NAMES
from covis.evaluation.suites import SUITES
from covis.evaluation.synthetic import PREFIX, problem_names
from covis.scripts.main import app
from covis.scripts.speed import AREAS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHELL = {"sh", "bash", "shell", "console"}
EXEMPT = {
    "pip": "installs from a registry; the extras it names are checked",
    "make": "sets up environments of its own; that the target exists is checked",
    "python": "runs a file of this repository, which must exist",
    "rerun": "opens a window",
    "ray": "starts a cluster",
    "git": "belongs to the reader's own copy",
    "cd": "belongs to the reader's own folders",
    "export": "belongs to the reader's own shell",
}
LINK = re.compile(r"\]\((?!https?://|#)([^)#]+)")
FILE = re.compile(r"# ([\w/]+\.py)\n")
STAND_IN = "box_world:BoxWorld"
"""A scene that takes a second, in place of the real ones."""
QUICK = {
    "benchmark": ["--episodes", "1"],
    "view": ["--episodes", "1"],
    "record": ["--episodes", "1"],
    "check": [],
    "export": [],
}
"""Subcommands that are run, with the options that make them short; others are only parsed."""


@dataclass(frozen=True)
class Block:
    """A code block: its language ("" = indented), its text and the line of the page it begins on."""

    language: str
    text: str
    line: int


class Page:
    """A page, its blocks, and the files they leave for one another."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tokens = MarkdownIt("commonmark").enable("table").parse(path.read_text(encoding="utf-8"))
        self.made: set[str] = set()

    def blocks(self) -> Iterator[Block]:
        for token in self.tokens:
            if token.type in ("fence", "code_block"):
                words = token.info.split()
                yield Block(words[0] if words else "", token.content, token.map[0] + 1)

    def mentions(self) -> Iterator[tuple[int, str]]:
        """`covis ...` in running text and tables, with its line."""
        for token in self.tokens:
            for child in token.children or ():
                if child.type == "code_inline" and child.content.startswith("covis "):
                    yield token.map[0] + 1, child.content

    def problem(self, line: int, command: str, what: object) -> str:
        return f"{self.path.relative_to(ROOT)}:{line}: `{command}`: {what}"

    def commands(self) -> Iterator[tuple[int, str, list[str]]]:
        """Line, text and words of every shell command, continued lines joined, comments and environment left out."""
        for block in self.blocks():
            if block.language in SHELL or not block.language:
                for text in block.text.replace("\\\n", " ").splitlines():
                    words = shlex.split(text.removeprefix("$ "), comments=True)
                    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                        words.pop(0)
                    if words:
                        yield block.line, " ".join(words), words


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


def subcommand(words: list[str]) -> tuple[Any, list[str], list[str]]:
    """The click command that words (without `covis`) call, its name, and the words left for it."""
    command, name, rest = typer.main.get_command(app), [], list(words)
    while hasattr(command, "commands"):
        if not rest or rest[0] not in command.commands:
            there = ", ".join(sorted(command.commands))
            raise ValueError(f"no subcommand {rest[0] if rest else ''!r} of covis {' '.join(name)}; there are {there}")
        name.append(rest.pop(0))
        command = command.commands[name[-1]]
    return command, name, rest


def parsed(words: list[str]) -> tuple[list[str], dict[str, Any]]:
    """Name and parameters of a command, or whatever the command line would complain of."""
    command, name, rest = subcommand(words)
    return name, command.make_context(" ".join(name), rest).params


def is_generated(target: str) -> bool:
    """Whether a target, with a shell's braces, names generated problems."""
    pattern = re.sub(r"{(.*?)}", lambda braces: f"({braces[1].replace(',', '|')})", target)
    return any(re.fullmatch(pattern, PREFIX + problem) for problem in problem_names())


def check_parameters(name: list[str], params: dict[str, Any], page: Page) -> None:
    """What parsing alone does not see: names of targets, methods and areas."""
    local = {path.stem for path in Path().glob("*.py")}
    for text in params.get("method") or () if isinstance(params.get("method"), list) else ():
        method = Method.parse(text)
        if method.name.partition(":")[0] not in {*local, "mypkg.mine"}:
            method.load()
    targets = params.get("targets") or [params[k] for k in ("target", "scene") if k in params]
    for target in targets if name[0] in ("benchmark", "view", "record", "train") else ():
        known = target in {*SCENE_NAMES, *SUITES, "perception"} or ":" in target or is_generated(target)
        if not (known or target in page.made or target.startswith(("path/to/", "../shared/data")) or target.isupper()):
            raise ValueError(
                f"target {target!r} is no scene or suite, was not made above on this page, and is no placeholder "
                "(path/to/..., or a word in capitals)"
            )
    if name[0] == "speed" and params["area"] not in AREAS:
        raise ValueError(f"no area is called {params['area']!r}")


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "page"}
    for block in Page(page).blocks():
        if block.language == "python":
            # Empty lines in front, so that tracebacks name the page's own lines.
            exec(compile("\n" * block.line + block.text, str(page), "exec"), namespace)
        elif block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "json":
            json.loads(block.text)
        else:
            assert block.language in {*SHELL, "", "text"}, (
                f"{page_id(page)}:{block.line}: blocks in {block.language!r} are not tested: use python, sh, toml, "
                "json, or text for what a program prints"
            )


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_commands_are_right(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = Page(page)
    write_files(here)
    problems = []
    for line, text, words in here.commands():
        try:
            check_command(words, here)
        except Exception as error:
            problems.append(here.problem(line, text, getattr(error, "message", error)))
    for line, text in here.mentions():
        try:
            check_mention(text)
        except ValueError as error:
            problems.append(here.problem(line, text, error))
    assert not problems, "\n".join(problems)


def check_command(words: list[str], page: Page) -> None:
    program = words[0]
    if program == "covis":
        name, params = parsed(words[1:])
        check_parameters(name, params, page)
        page.made |= {str(params[key]) for key in ("out", "out_dir", "folder", "file") if params.get(key)}
    elif program == "make":
        for target in words[1:]:
            if not re.search(rf"^{re.escape(target)}:", (ROOT / "Makefile").read_text(), re.MULTILINE):
                raise ValueError(f"the Makefile has no target {target!r}")
    elif program == "pip":
        known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        for extra in re.findall(r"[\w,]+(?=\])", " ".join(words)):
            missing = set(extra.split(",")) - set(known)
            if missing:
                raise ValueError(f"no extra is called {missing.pop()!r}; there are {', '.join(known)}")
    elif program == "python":
        if len(words) > 1 and words[1].endswith(".py") and not (ROOT / words[1]).exists():
            raise ValueError(f"{words[1]} is not in the repository")
    elif program not in EXEMPT:
        raise ValueError(
            f"{program!r} is not known here: name it in EXEMPT of tests/test_docs.py with a reason, or, if the block "
            "is no command, fence it with its language (```python, ```text)"
        )


def check_mention(text: str) -> None:
    """A command named in running text: its subcommand and its options exist."""
    words = re.sub(r"[\[\]]|\.\.\.", " ", text).replace("\\|", "|").split()[1:]
    if "|" in words or not words[0].islower():  # `covis a | b`, `covis TARGET`: a list, no command
        return
    group = hasattr(typer.main.get_command(app).commands.get(words[0]), "commands")
    if group and len(words) == 1:
        return
    for second in words[1].split("|") if group else [""]:
        command, name, rest = subcommand([words[0], second, *words[2:]] if group else words)
        options = {option for parameter in command.params for option in parameter.opts}
        unknown = [w for w in rest if w.startswith("--") and w.split("=")[0] not in options]
        if unknown:
            there = ", ".join(sorted(options))
            raise ValueError(f"covis {' '.join(name)} has no option {unknown[0]}; it has {there}")


def write_files(page: Page) -> None:
    """The files that the page tells its reader to write."""
    for block in page.blocks():
        name = FILE.match(block.text) if block.language == "python" else None
        if name:
            Path(name[1]).write_text(block.text)


def runnable(page: Page) -> list[tuple[int, list[str]]]:
    """Commands of the page to run, with stand-ins for scenes and the reader's data.

    Those under results say how figures were measured: on other things they say nothing, so they are only parsed.
    """
    if page.path.is_relative_to(ROOT / "docs" / "results"):
        return []
    out: list[tuple[int, list[str]]] = []
    made: set[str] = set()
    for line, _, words in page.commands():
        if words[0] != "covis" or words[1] not in QUICK or any(slow(word) for word in words):
            continue
        swapped, eyes = ["covis"], []
        for word, before in zip(words[1:], words, strict=False):
            if before in ("--out", "--json"):
                made.add(word)
            if word in SCENE_NAMES:
                word, eyes = STAND_IN, ["--perception", "simulated"]  # learned ones do not know its classes
            elif word not in made and (word.startswith("path/to/") or word.isupper()):
                word = "small"
            if word != STAND_IN or word not in swapped:
                swapped.append(word)
        left_out = ("--episodes", "--preset", "--workers", *eyes[:1])
        out.append((line, without(swapped[1:], left_out) + QUICK[words[1]] + eyes))
    return out


def slow(word: str) -> bool:
    """Words that make a command take long, or need what is not here."""
    return word in (*SUITES, "perception", "learned", "ray") or word.startswith(("mypkg", "../shared"))


def without(words: list[str], options: tuple[str, ...]) -> list[str]:
    """Words less these options and their values."""
    return [w for w, before in zip(words, ["", *words], strict=False) if w not in options and before not in options]


@pytest.mark.parametrize("page", [p for p in PAGES if runnable(Page(p))], ids=page_id)
def test_quick_commands_run(page, small_dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    here = Page(page)
    write_files(here)
    for module in Path().glob("*.py"):
        monkeypatch.delitem(sys.modules, module.stem, raising=False)
    for line, words in runnable(here):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, here.problem(line, " ".join(words), f"{result.output}{result.stderr}")


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page):
    missing = [link for link in LINK.findall(page.read_text()) if not (page.parent / link).exists()]
    assert not missing


def test_every_page_is_in_the_book():
    """The site's strict build finds broken links; this says, without a build, which page nobody links to."""
    docs = ROOT / "docs"
    pages = {str(page.relative_to(docs)) for page in docs.rglob("*.md")} - {"README.md"}
    index = set(LINK.findall((docs / "README.md").read_text()))
    site = set(re.findall(r": ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)) - {"README.md"}
    assert pages <= index, f"add to docs/README.md: {', '.join(sorted(pages - index))}"
    assert pages == site, f"the nav of mkdocs.yml differs from docs/ in: {', '.join(sorted(pages ^ site))}"


class TestTheChecksThemselves:
    """A page with each mistake is refused."""

    @pytest.mark.parametrize(
        ("command", "message"),
        [
            ("covis bench multi_robot", "no subcommand 'bench'"),
            ("covis train nothing", "no subcommand 'nothing' of covis train"),
            ("covis benchmark multi_robot --colour red", "--colour"),
            ("covis benchmark multi_robots", "target 'multi_robots' is no scene or suite"),
            ("covis benchmark multi_robot --method nope", "no matcher is called 'nope'"),
            ("covis speed everything", "no area is called 'everything'"),
            ("pip install 'covis[nothing]'", "no extra is called 'nothing'"),
            ("make nothing", "no target 'nothing'"),
            ("python docs/examples/nothing.py", "is not in the repository"),
            ("frobnicate", "name it in EXEMPT"),
        ],
    )
    def test_commands(self, command, message, tmp_path):
        page = tmp_path / "page.md"
        page.write_text(f"Text.\n\n    {command}\n")
        ((_, _, words),) = Page(page).commands()
        with pytest.raises(Exception, match=re.escape(message)):
            check_command(words, Page(page))

    def test_mentions(self):
        check_mention("covis record SCENE --episodes E --out DIR")
        check_mention("covis demo | benchmark")
        check_mention("covis train perception|policy")
        check_mention("covis import")
        with pytest.raises(ValueError, match="no option --colour"):
            check_mention("covis record SCENE [--colour C]")
        with pytest.raises(ValueError, match="no subcommand 'nothing'"):
            check_mention("covis train perception|nothing")
