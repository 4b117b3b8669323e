"""The shape of the house: imports run one way, the command line starts without JAX, public names are there."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import gacrl
from gacrl.tasks.spread.settings import SpreadSettings

PACKAGE = Path(gacrl.__file__).parent

TASKS = tuple(f"tasks.{path.parent.name}" for path in sorted((PACKAGE / "tasks").glob("*/settings.py")))
SETTINGS_OF_TASKS = tuple(f"{task}.settings" for task in TASKS)

LAYERS = (
    (
        "errors",
        "extras",
        "replacing",
        "types",
        "versions",
        "config",
        "tasks",
        "evaluation.statistics",
        *SETTINGS_OF_TASKS,
    ),
    (
        "cli.arguments",
        "envs",
        "messages.interventions",
        "networks",
        "report",
        "scene",
        "export.bundle",
    ),
    ("tasks.own", "tasks.foreign", *TASKS),
    ("algorithms",),
    ("rollout", "hosting"),
    ("evaluation",),
    ("adapters", "messages", "pen", "reel", "render"),
    ("film", "export.replays"),
    ("training",),
    ("experiments", "play", "api"),
    ("export",),
    ("viewer",),
    ("cli", "doctor"),
    ("__main__",),
)
"""A room may import from its own layer and those above it in this list. A file may have a layer of its own."""
LEVEL = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}


def room_of(module: str) -> str:
    """The longest part of a dotted name that is in a layer; KeyError where none is."""
    parts = module.split(".")
    for end in range(len(parts), 0, -1):
        if (room := ".".join(parts[:end])) in LEVEL:
            return room
    raise KeyError(module)


def modules_imported(source: str) -> Iterator[tuple[int, str]]:
    """Line and dotted name of all that is imported from this package, also inside functions; not for type checkers."""
    for node in without_type_checking(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"line {node.lineno}: a relative import")
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            package, _, rest = name.partition(".")
            if package == "gacrl":
                yield node.lineno, rest


def without_type_checking(node: ast.AST) -> Iterator[ast.AST]:
    yield node
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            child = ast.Module(child.orelse, [])
        yield from without_type_checking(child)


def backward_imports(room: str, source: str) -> list[str]:
    """A room that is in no layer, and one that the package does not have, raise KeyError."""
    return [
        f"line {line}: {room} imports {room_of(imported)}"
        for line, imported in modules_imported(source)
        if LEVEL[room_of(imported)] > LEVEL[room]
    ]


MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


NAMES = {name_of(path) for path in MODULES}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(path: Path):
    source = path.read_text(encoding="utf-8")
    assert backward_imports(room_of(name_of(path)), source) == []
    assert ast.get_docstring(ast.parse(source)), "a module says what it holds"


def test_every_layer_stands_on_files():
    assert {room_of(name_of(path)) for path in MODULES} == set(LEVEL)


def test_no_file_imports_itself_by_way_of_others():
    imports = {
        name_of(path): {
            next(name for name in (imported, imported.rpartition(".")[0]) if name in NAMES)
            for _, imported in modules_imported(path.read_text(encoding="utf-8"))
        }
        for path in MODULES
    }
    tuple(TopologicalSorter(imports).static_order())  # raises CycleError, which names the circle


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from gacrl.envs import copies\nimport gacrl.config", []),
        ("import gacrl.training.loop", ["line 1: rollout imports training"]),
        ("def f():\n    from gacrl import play as p", ["line 2: rollout imports play"]),
        (
            "if TYPE_CHECKING:\n    from gacrl import cli\nelse:\n    import gacrl.api",
            ["line 4: rollout imports api"],
        ),
        ("import jax\nfrom gacrlother import cli", []),
    ],
)
def test_a_backward_import_is_seen(source: str, found: list[str]):
    assert backward_imports("rollout", source) == found


def test_an_unknown_room_is_seen():
    with pytest.raises(KeyError, match="cellar"):
        backward_imports("cli", "from gacrl.cellar import wine")


def words_of(source: str) -> set[str]:
    """Every name and every text of a file, except its docstrings."""
    tree = ast.parse(source)
    said = {
        node.value.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in said:
            found |= set(re.findall(r"\w+", node.value))
        for field in ("id", "attr", "arg", "name", "module"):
            name = getattr(node, field, None)
            found |= set(name.split(".")) if isinstance(name, str) else set()
    return found


KNOWS_SPREAD = (
    "tasks",
    "adapters/mpe2",
    "algorithms/gacrl_paper",
    "experiments/paper",
    "config/presets",
    "config/run",
)
"""What may: the task itself, MPE2 and the paper, which are about it, the presets, and who takes it where none is named."""
SPREADS_OWN = {
    "Spread",
    "SpreadSettings",
    "SpreadParams",
    "SpreadState",
    "oracle",
    "near_agents",
    "collisions",
} | {
    field.name
    for field in fields(SpreadSettings)
    if field.name not in ("num_agents", "max_cycles", "continuous_actions", "reward")
}


def test_nobody_but_a_task_knows_its_names():
    """No setting, parameter or metric of spread stands outside `tasks`; what one line of a preset is about aside."""
    known = {
        str(path.relative_to(PACKAGE)): sorted(
            word
            for word in words_of(path.read_text(encoding="utf-8"))
            if word in SPREADS_OWN or word.startswith("coverage_")
        )
        for path in MODULES
        if not str(path.relative_to(PACKAGE)).startswith(KNOWS_SPREAD)
    }
    allowed = {
        "cli/main.py": ["oracle"],  # an example in its help
        "config/algorithms.py": ["coverage_signal"],  # the paper's
        "config/former.py": ["coverage_radius"],  # of version 0.1.0
        "doctor.py": ["oracle"],  # here and in MPE2
    }
    assert {name: words for name, words in known.items() if words} == allowed


def test_settings_of_tasks_are_leaves():
    """Help shows them without loading JAX."""
    for path in (PACKAGE / "tasks").rglob("settings.py"):
        imported = {room_of(name) for _, name in modules_imported(path.read_text(encoding="utf-8"))}
        assert imported <= {"errors", "config", "tasks"}, path


def test_the_command_line_starts_without_jax():
    """`import gacrl` loads no numpy either; help, the list of presets and mistakes need none of it."""
    code = """
import sys
def loaded():
    return sorted({name.partition(".")[0] for name in sys.modules} & {"jax", "numpy", "equinox", "scipy"})
import gacrl
print("gacrl", loaded(), dir(gacrl) and "")
import gacrl.config.files, gacrl.errors, gacrl.cli.main, gacrl.cli.arguments
print("cli", "jax" in loaded())
for words in (["--help"], ["presets"], ["config"], ["train", "--nonsense"], ["trian"], ["evaluate", "--help"]):
    try:
        gacrl.cli.main.main(words)
    except SystemExit:
        pass
print("commands", "jax" in loaded())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    lines = done.stdout.splitlines()
    assert lines[0] == "gacrl [] "
    assert "cli False" in lines
    assert lines[-1] == "commands False"


def test_reports_stand_on_leaves():
    """A page and its figures are made from numbers alone."""
    pages = (PACKAGE / "report").glob("*.py")
    assert {room_of(name) for path in pages for _, name in modules_imported(path.read_text())} <= {
        "errors",
        "report",
    }


def test_statistics_and_reports_start_without_jax():
    code = """
import sys
import gacrl.evaluation.statistics, gacrl.report.page, gacrl.experiments.compare.report
print("jax" in sys.modules, "matplotlib" in sys.modules)
import gacrl.report.figures
print("jax" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.split() == ["False", "False", "False"]


def test_public_names_exist_and_say_what_they_are():
    assert sorted(gacrl.__all__) == gacrl.__all__
    for name in gacrl.__all__:
        thing = getattr(gacrl, name)
        assert inspect.getdoc(thing), name
        assert thing.__doc__, f"{name} has no docstring of its own"
        assert name in dir(gacrl)
        assert getattr(importlib.import_module(thing.__module__), name) is thing


def test_type_checkers_see_the_same_names():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: node.module
        for node in ast.walk(block)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(seen) == gacrl.__all__
    for name, home in seen.items():
        assert getattr(importlib.import_module(str(home)), name) is getattr(gacrl, name)


def test_an_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = gacrl.trian
