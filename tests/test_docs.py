"""The pages under docs: examples run, commands parse, messages exist, and the rig reference is current."""

import re
import runpy
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest
import typer.main

from datasets.__main__ import main as make_dataset
from tbmfg.cli import app
from tbmfg.estimators import ESTIMATORS, OWN
from tbmfg.rig import KINDS, parse_rig

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    log = tmp_path_factory.mktemp("docs") / "drive.mcap"
    assert make_dataset(["make", "tbm-drive", "-o", str(log), "--duration", "8", "--set", "imu_rate_hz=100"]) == 0
    return log


def as_modules(page: Path, monkeypatch) -> list[str]:
    """Make modules of the blocks that begin with a file's name, and entry points of the lines that declare them; return
    the other blocks."""
    rest = []
    for code in blocks(page, "python"):
        named = re.match(r"# (\w+)/(\w+)\.py\n", code)
        if named is None:
            rest.append(code)
            continue
        module = ModuleType(".".join(named.groups()))
        monkeypatch.setitem(sys.modules, named[1], ModuleType(named[1]))
        monkeypatch.setitem(sys.modules, module.__name__, module)
        exec(code, module.__dict__)
    points = []
    for text in blocks(page, "toml"):
        groups = tomllib.loads(text)["project"].get("entry-points", {})
        points += [EntryPoint(*item, group) for group, items in groups.items() for item in items.items()]
    monkeypatch.setattr("tbmfg.registry.entry_points", lambda group: [p for p in points if p.group == group])
    return rest


@pytest.fixture
def registries():
    """Both read their entry points anew, before the test and after it."""

    def forget() -> None:
        for registry in (ESTIMATORS, KINDS):
            registry.__dict__.pop("data", None)

    forget()
    yield
    forget()


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem)
def test_python_runs(page, drive, registries, monkeypatch):
    monkeypatch.chdir(drive.parent)
    code = as_modules(page, monkeypatch)
    for text in blocks(page, "yaml"):
        rig = parse_rig(text, page.name)
        Path(f"{rig.name}.yaml").write_text(text, "utf-8")
    for one in code:
        exec(one, {})


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "yaml")], ids=lambda page: page.stem)
def test_rigs_parse(page, registries, monkeypatch):
    as_modules(page, monkeypatch)
    for text in blocks(page, "yaml"):
        assert parse_rig(text, page.name).sensors["imu"]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_commands_parse(page):
    """Every command of tbmfg on the page, in a block or in a sentence, has the options that it is shown with."""
    program = typer.main.get_command(app)
    text = page.read_text("utf-8")
    lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
    lines += re.findall(r"`(tbmfg [^`]*)`", text)
    for line in lines:
        name, *words = line.split("#")[0].split() or [""]
        if name != "tbmfg":
            continue
        command = program if words[0].startswith("-") else program.commands[words.pop(0)]
        options = {name for parameter in command.params for name in parameter.opts}
        shown = {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert shown <= options, line


def test_messages_are_those_of_the_program():
    """Runs of literal text between the numbers of a message; what is looked for has to be there."""
    source = "".join(path.read_text("utf-8") for path in sorted((ROOT / "tbmfg").rglob("*.py")))
    joined = re.sub(r'"\s*\n\s*f?"', "", source)  # strings over several lines
    headings = re.findall(r"^### `(.*)`$", (DOCS / "troubleshooting.md").read_text("utf-8"), re.MULTILINE)
    assert len(headings) > 15
    assert [words for words in headings if words not in joined] == []


def test_every_estimator_has_its_place():
    """Under its own name, or with its family: shearer-*, sbm-*."""
    text = (DOCS / "estimators.md").read_text("utf-8")
    headings = re.findall(r"^## `([\w-]+)(\*?)`$", text, re.MULTILINE)
    exact = {name for name, star in headings if not star}
    families = tuple(name for name, star in headings if star)
    assert exact <= set(OWN)
    assert all(any(name.startswith(family) for name in OWN) for family in families)
    assert set(re.findall(r"^- `([\w-]+)`:", text, re.MULTILINE)) <= set(OWN)


def test_the_rig_reference_is_current():
    made = runpy.run_path(str(DOCS / "make_rig_reference.py"))
    assert (DOCS / "rig.md").read_text("utf-8") == made["reference"](), "run: python docs/make_rig_reference.py"


def test_links_lead_somewhere():
    for page in [*PAGES, ROOT / "README.md"]:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text("utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
