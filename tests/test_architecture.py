"""The house rules that no reviewer should have to remember."""

import ast
import graphlib
import importlib
import pkgutil
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import trms_cli
from tests.program import loaded_by
from trms_cli.composition.catalogue import first_comment, read_groups, read_primary, read_yaml
from trms_cli.core.plugins import TARGET, locate
from trms_cli.core.resources import config_folder

PACKAGE = Path(trms_cli.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
SOURCES = {module: module.read_text(encoding="utf-8") for module in MODULES}
TREES = {module: ast.parse(source) for module, source in SOURCES.items()}
# A field of such a type has a unit, a shape or a meaning that no name can tell.
NUMERIC = re.compile(r"\b(float|FloatArray|NDArray|ndarray|Positive|NonNegative)\b")

# Imports point down this list or stay on their level, never up.
LEVELS = [
    {"core"},
    {"models"},
    {"controllers", "observers", "references", "effects"},
    {"simulation", "plants"},
    {
        "code_generation",
        "gap",
        "identification",
        "stability",
        "reporting",
        "scoring",
        "runs",
        "sweeps",
    },
    {"composition"},
    {"library"},
    {"commands"},
    {"cli", "__main__"},
]
# `recordings` stands beside the levels: it knows files, the core and what a model's signals are,
# and these may use it.
READERS_OF_RECORDINGS = {
    "commands",
    "identification",
    "library",
    "plants",
    "references",
    "runs",
    "scoring",
    "simulation",
}

# Who may import what, everywhere in a module, inside functions too.
RESTRICTED = {
    "hydra": {"composition"},
    "omegaconf": {"composition"},
    "rich": {"commands", "reporting"},
    "matplotlib": {"reporting"},
    "mcap": {"recordings"},
    "pyarrow": {"recordings", "runs"},
    "pint": {"recordings"},
    "scipy.io": {"recordings"},
    "starlette": {"library"},
    "uvicorn": {"library"},
}

# What `trms --help` must not wait for.
HEAVY = {
    "numpy", "scipy", "casadi", "hydra", "omegaconf", "rich", "matplotlib", "pyarrow", "uvicorn",
}  # fmt: skip
LIGHT_ENOUGH = {"yaml", "msgspec"}  # but not for the first page


def _name(module: Path) -> str:
    return module.relative_to(PACKAGE).as_posix()


def _room(module: Path) -> str:
    parts = module.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else module.stem


class _Imports(ast.NodeVisitor):
    """Dotted names of all that a module imports, wherever the statement stands.

    At run time those for type checkers alone are left out.
    """

    def __init__(self, module: Path, *, at_run_time: bool) -> None:
        self._module, self._at_run_time, self.names = module, at_run_time, set[str]()
        self.visit(TREES[module])

    def visit_If(self, node: ast.If) -> None:
        for_types = self._at_run_time and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in node.orelse if for_types else [node.test, *node.body, *node.orelse]:
            self.visit(inner)

    def visit_Import(self, node: ast.Import) -> None:
        self.names |= {alias.name for alias in node.names}

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        assert node.level == 0, f"{_name(self._module)}: imports are absolute"
        self.names |= {f"{node.module}.{alias.name}" for alias in node.names}


@cache
def _imports(module: Path, *, at_run_time: bool = False) -> set[str]:
    return _Imports(module, at_run_time=at_run_time).names


def _level(room: str) -> int:
    return next(i for i, rooms in enumerate(LEVELS) if room in rooms)


def _rooms_imported(module: Path, *, at_run_time: bool = False) -> set[str]:
    found = _imports(module, at_run_time=at_run_time)
    names = (name.split(".") for name in found if name.startswith("trms_cli."))
    return {parts[1] for parts in names} - {"__version__"}


def _upward_imports(module: Path) -> set[str]:
    """Rooms above its own that a module imports."""
    room = _room(module)
    if room == "__init__":
        return _rooms_imported(module, at_run_time=True)
    imported = _rooms_imported(module)
    if room == "recordings":
        return imported - {"recordings", "core", "models"}
    if room in READERS_OF_RECORDINGS:
        imported -= {"recordings"}
    if room == "commands":  # a command may ask the dispatcher which commands there are
        imported -= {"cli"}
    above = {other for other in imported - {"recordings"} if _level(other) > _level(room)}
    return above | (imported & {"recordings"})


def test_imports_point_down():
    upward = {_name(module): above for module in MODULES if (above := _upward_imports(module))}
    assert not upward


def test_each_module_can_be_imported():
    """A type checker says nothing of an import of a module that is not there any more."""
    names = [info.name for info in pkgutil.walk_packages([str(PACKAGE)], "trms_cli.")]
    assert len(names) == len(MODULES) - 1
    for name in names:
        if not name.endswith("__main__"):
            importlib.import_module(name)


def test_libraries_stay_in_their_rooms():
    strays = {
        (library, _name(module))
        for module in MODULES
        for name in _imports(module)
        for library, rooms in RESTRICTED.items()
        if (name == library or name.startswith(f"{library}.")) and _room(module) not in rooms
    }
    assert not strays


def test_each_module_and_public_class_says_what_it_is_for():
    silent = [_name(module) for module, tree in TREES.items() if not ast.get_docstring(tree)]
    silent += [
        f"{_name(module)}: {node.name}"
        for module, node in _public(ast.ClassDef)
        if not ast.get_docstring(node)
    ]
    assert not silent


def test_numbers_of_public_dataclasses_are_explained():
    missing = [
        f"{_name(module)}: {node.name}.{field}"
        for module, node in _public(ast.ClassDef)
        if any("dataclass" in ast.unparse(mark) for mark in node.decorator_list)
        for field in _unexplained_fields(node, SOURCES[module].splitlines())
    ]
    assert not missing


#: Words of our own that nobody in the field would search for; they name nothing public.
DIALECT = re.compile(
    r"(^|_)(told|telling|found|asked|seen|said|inquiry|contest|contestant|suspects?|far|account|"
    r"crew|ledger|believed|heard|watched|gathered|looked|wish|entrant|swept)(_|$)"
)


def _public(kind: type) -> Iterator[tuple[Path, ast.ClassDef]]:
    """Public definitions of a kind at the top of modules."""
    for module, tree in TREES.items():
        for node in tree.body:
            if isinstance(node, kind) and not node.name.startswith("_"):
                yield module, node


def test_names_are_the_fields_words():
    names = [(_name(module), module.stem) for module in MODULES]
    names += [(_name(m), node.name) for m, node in _public((ast.ClassDef, ast.FunctionDef))]
    strange = [
        (module, name)
        for module, name in names
        if DIALECT.search(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower())
    ]
    assert not strange


def test_no_two_public_classes_have_one_name():
    homes: dict[str, list[str]] = {}
    for module, node in _public(ast.ClassDef):
        homes.setdefault(node.name, []).append(_name(module))
    shared = {name: places for name, places in homes.items() if len(places) > 1}
    assert not shared


def _unexplained_fields(node: ast.ClassDef, lines: list[str]) -> Iterator[str]:
    """Public numbers and arrays without a word in the docstring, a comment or a string."""
    comments = (line for line in lines[node.lineno - 1 : node.end_lineno] if "#:" in line)
    explained = "\n".join([ast.get_docstring(node) or "", *comments])
    for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        name = statement.target.id
        annotation = ast.unparse(statement.annotation)
        if name.startswith("_") or "ClassVar" in annotation or not NUMERIC.search(annotation):
            continue
        described = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        above = lines[statement.lineno - 2].strip() if statement.lineno > 1 else ""
        own = lines[statement.lineno - 1 : statement.end_lineno]
        commented = above.startswith("#") or any("#" in line for line in own)
        if not described and not commented and not re.search(rf"\b{name}\b", explained):
            yield name


def _graph() -> dict[str, set[str]]:
    """The imported modules of each module, by dotted names."""
    names = {
        ".".join(("trms_cli", *module.relative_to(PACKAGE).with_suffix("").parts)): module
        for module in MODULES
    }
    names = {name.removesuffix(".__init__"): module for name, module in names.items()}
    graph = {}
    for name, module in names.items():
        found = _imports(module, at_run_time=True)
        # what is imported from a module that is no module itself is of that one
        homes = {each if each in names else each.rpartition(".")[0] for each in found}
        graph[name] = (homes & names.keys()) - {name}
    return graph


def test_no_circle_of_imports():
    graphlib.TopologicalSorter(_graph()).prepare()  # an error names the circle


def test_rooms_that_do_not_know_each_other():
    """What controllers and observers both need lies below them."""
    rooms = {"controllers", "observers"}
    for module in MODULES:
        if _room(module) in rooms:
            assert not rooms & _rooms_imported(module) - {_room(module)}, _name(module)


def _configs() -> list[Path]:
    return sorted(config_folder().rglob("*.yaml"))


def test_each_configuration_begins_with_its_description_and_is_no_other():
    assert not [file for file in _configs() if len(first_comment(file)) < 10]
    assert len({file.read_bytes() for file in _configs()}) == len(_configs())


def test_the_classes_of_configurations_are_there():
    for file in _configs():
        nodes = [read_yaml(file)]
        while nodes:
            node = nodes.pop()
            if isinstance(node, dict):
                if TARGET in node:
                    locate(node[TARGET], file.name)
                nodes += node.values()
            elif isinstance(node, list):
                nodes += node


def test_every_key_of_a_plugin_is_explained():
    """A value of a plugin carries a comment: its unit and what it means.

    What the plugin acts on, which its name says too, needs none.
    """
    value = re.compile(r"\s*(?!_|(rotor|axis|channel|kind|equation|input):)\w+:\s*[^\s#]")
    bare = [
        (file.name, line)
        for file in _configs()
        if "_target_:" in (text := file.read_text(encoding="utf-8"))
        for line in text.splitlines()
        if value.match(line) and "#" not in line
    ]
    assert not bare


def test_the_defaults_of_run_and_every_option_are_explained_and_exist():
    declared, groups = read_primary("run"), read_groups()
    for group, option in declared.defaults.items():
        assert declared.about[group], group
        if isinstance(option, str):
            assert option in groups[group], f"{group}={option}"
    for options in groups.values():
        for option in options.values():
            assert option.summary, option.file


@pytest.mark.parametrize(
    ("argv", "heavy"),
    [
        (["--help"], HEAVY | LIGHT_ENOUGH),
        (["list"], HEAVY),
        (["run", "--help"], HEAVY),
        (["completion", "bash"], HEAVY),
    ],
)
def test_the_quick_commands_wait_for_nothing_heavy(argv, heavy, tmp_path):
    assert not loaded_by(f"import trms_cli.cli as c; c.main({argv})", tmp_path) & heavy
