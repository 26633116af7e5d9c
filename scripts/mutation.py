"""Changes that the tests should notice: a random sample of mutants, room by room.

    pip install cosmic-ray                  # operators and session database; needed by nothing else
    python scripts/mutation.py --room device_sensor --mutants 60 --seed 1
    python scripts/mutation.py --room all --mutants 40 --seed 2 --session build/mutants.sqlite

Each mutant is one small change of one line (cosmic-ray's operators: another operator, comparison or
number, a condition turned round, a loop that does not run, …). It is killed if a test of its room fails or
exceeds the time-out, and has survived if all pass. Only tests that reach its statement are asked (all of
them if it runs at import), the cheapest first. Everything happens in a copy in a temporary folder.

Tests are collected once. For each mutant a forked process gives the function the code that it would have
and runs them, so that neither imports nor collection are paid again; what runs at import is imported by
another interpreter. A mutant in a statement that no test of the room reaches has survived at once.

The draw takes as many different lines as there are, uniformly, before any line comes twice, and on a
line a place and one of the place's mutants. Not drawn, since no behaviour hangs on them: annotations,
type aliases, `__all__`, texts of errors, warnings and log, flags that guard only against the programmer
(`strict` of zip, `frozen` and `slots` of a dataclass, `abstractmethod`), decorators that only cache or
inform a type checker, generated files (a test compares them with their source), and mutants that do not
compile. Docstrings have no mutants.

Printed: every survivor with file, line and difference; then per room mutants, killed, timed out, survived,
score (share that did not survive) and its 95 % interval (Wilson). A survivor is either *equivalent* (no
input could tell) or a missing test; which of the two only a reader can say, so the score counts both.

With `--session` the work is kept in a database of cosmic-ray (one a room: the room's name is added) and an
interrupted run goes on where it stopped; `cr-report` and `cr-html` read it too.
"""

from __future__ import annotations

import argparse
import ast
import builtins
import contextlib
import difflib
import gc
import importlib
import itertools
import math
import os
import pickle
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import uuid
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import CodeType, FunctionType
from typing import TYPE_CHECKING, Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from levels import is_quick, level_of

if TYPE_CHECKING:
    from cosmic_ray.work_item import MutationSpec, WorkItem, WorkResult

ROOT = Path(__file__).resolve().parents[1]
SOURCE = "src/adis_gonio"
TESTS = ROOT / "tests"
GENERATED = {"device/bus/wire/protocol.py"}  # a test compares it with its source
ARGUMENTS = ("-q", "--no-header", "--tb=line", "-p", "no:cacheprovider", "--hypothesis-seed=0", "-n", "0")


@dataclass(frozen=True)
class Room:
    """A package: its files in `src/adis_gonio` without generated ones, and the test files to ask."""

    files: tuple[str, ...]
    tests: tuple[str, ...]


def rooms() -> dict[str, Room]:
    """Return a room for each package; `device` has one for the bridges and one for the sensor.

    The tests of a room are the files of level `unit` in the package's folder of tests, and the quick files
    of other folders that import from the package.
    """
    texts = {
        PurePosixPath(path.relative_to(TESTS).as_posix()): path.read_text("utf-8")
        for path in sorted(TESTS.rglob("test_*.py"))
    }
    source = ROOT / SOURCE
    names = {path.parent.name for path in source.glob("*/__init__.py")} - {"device"}
    result = {}
    for name in sorted(names | {"device/bus", "device/sensor"}):
        imports = re.compile(rf"\badis_gonio\.{name.replace('/', '.')}\b")
        files = {path.relative_to(source).as_posix() for path in (source / name).rglob("*.py")} - GENERATED
        own = [file for file in texts if file.is_relative_to(name) and level_of(file) == "unit"]
        others = [file for file, text in texts.items() if is_quick(file) and imports.search(text)]
        tests = tuple(f"tests/{file}" for file in dict.fromkeys([*own, *others]))
        result[name.replace("/", "_")] = Room(tuple(sorted(files)), tests)
    return result


ROOMS = rooms()

NOT_ASKED = "not asked, since it fails without any mutant: "
NOT_EXCHANGED = 98  # exit status of a child

Place = tuple[int, int]  # line from 1, column from 0, in characters


def spared(code: str) -> list[tuple[Place, Place]]:
    """Ranges of a module that are not mutated."""
    lines = code.splitlines()
    tree = ast.parse(code)
    ranges = []

    def spare(node: ast.expr | ast.stmt) -> None:
        def place(line: int, octets: int) -> Place:
            return line, len(lines[line - 1].encode()[:octets].decode())

        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        ranges.append((place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset)))

    for node in ast.walk(tree):
        for part in _without_behaviour(node):
            spare(part)
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and _is_type(statement.value):
            spare(statement)
    return ranges


def _without_behaviour(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Parts of a node on which no behaviour hangs."""
    match node:
        case ast.arg(annotation=ast.expr() as annotation) | ast.AnnAssign(annotation=annotation):
            yield annotation
        case ast.Assign(targets=[ast.Name("__all__")]):
            yield node
        case ast.Raise():
            yield from (part for part in ast.walk(node) if isinstance(part, ast.JoinedStr))
        case ast.Call(func=func):
            name = _name(func)
            if name in {"warn", "debug", "info", "warning", "error"}:
                yield from (part for part in ast.walk(node) if isinstance(part, ast.JoinedStr))
            yield from (k.value for k in node.keywords if k.arg in {"strict", "frozen", "slots"})
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        if node.returns is not None:
            yield node.returns
        yield from (
            d
            for d in node.decorator_list
            if _name(d) in {"abstractmethod", "cache", "lru_cache", "dataclass_transform"}
        )


def _name(node: ast.expr) -> str:
    """Last part of a dotted name, of a call as well."""
    match node:
        case ast.Call(func=func):
            return _name(func)
        case ast.Attribute(attr=attr):
            return attr
        case ast.Name(name):
            return name
    return ""


def _is_type(node: ast.expr) -> bool:
    """Whether a module's constant is an alias of types: names and subscripts joined by `|`."""
    match node:
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            return _is_type(left) and _is_type(right)
        case ast.Subscript(value=value):
            return _is_type(value)
        case ast.Constant(None):
            return True
        case ast.Name(name):
            return name[:1].isupper() or name in {
                "int",
                "float",
                "str",
                "bytes",
                "bool",
                "tuple",
                "list",
                "dict",
            }
    return False


def mutants_by_line(copy: Path, room: Room) -> dict[tuple[str, int], dict[Place, list[MutationSpec]]]:
    """All mutants of a room by file and line, and there by place."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names
    from cosmic_ray.work_item import MutationSpec

    operators = {name: get_operator(name) for name in operator_names() if name != "core/NoOp"}
    usable = {name: operator() for name, operator in operators.items() if not operator.arguments()}
    found: dict[tuple[str, int], dict[Place, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for file in room.files:
        path = copy / SOURCE / file
        name = str(path.relative_to(copy))
        code = path.read_text("utf-8")
        not_drawn = spared(code)
        nodes = list(ast_nodes(get_ast(code)))
        for operator_name, operator in usable.items():
            places = (place for node in nodes for place in operator.mutation_positions(node))
            for occurrence, (start, end) in enumerate(places):
                # A decorator's place begins at its @, which is one before the expression.
                shifted = (start[0], start[1] + (operator_name == "core/RemoveDecorator"))
                if any(low <= shifted < high for low, high in not_drawn):
                    continue
                spec = MutationSpec(Path(name), operator_name, occurrence, start, end)
                found[(name, start[0])][start].append(spec)
    return found


def draw(copy: Path, room: Room, count: int, dice: random.Random) -> list[MutationSpec]:
    """A sample of mutants: different lines first, then places of a line, then mutants of a place."""
    order: list[tuple[int, float, Any]] = []
    for places in mutants_by_line(copy, room).values():
        for mutants in places.values():
            dice.shuffle(mutants)
        shuffled = dice.sample(list(places.values()), len(places))
        depth = max(map(len, shuffled))
        of_line = [mutants[k] for k in range(depth) for mutants in shuffled if k < len(mutants)]
        order += [(round_, dice.random(), mutant) for round_, mutant in enumerate(of_line)]
    order.sort(key=lambda item: item[:2])
    drawn: list[Any] = []
    for _, _, mutant in order:
        if len(drawn) == count:
            break
        if _is_a_change(copy, mutant):
            drawn.append(mutant)
    return drawn


def _is_a_change(copy: Path, mutant: MutationSpec) -> bool:
    """Whether a mutant compiles and is another program."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    code = (copy / mutant.module_path).read_text("utf-8")
    changed = mutate_code(code, get_operator(mutant.operator_name)(), mutant.occurrence)
    try:
        return changed is not None and ast.dump(ast.parse(changed)) != ast.dump(ast.parse(code))
    except SyntaxError:
        return False


def copy_of(root: Path, into: Path) -> Path:
    """Copy of the files that git knows or would take, as they stand in the checkout."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=root, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        if (root / name).is_file():
            (into / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, into / name)
    return into


class Watch:
    """Plugin of pytest that notes what each test costs and which mutants it reaches.

    A test that costs more than `longest_s` is skipped from there: it will not be asked.
    """

    def __init__(self, longest_s: float = math.inf) -> None:
        self.longest_s = longest_s
        self.cost_s: dict[str, float] = defaultdict(float)
        self.reached: dict[str, set[str]] = defaultdict(set)
        self.imported: set[str] = set()  # mutants that are reached at import
        self.failed: list[str] = []
        self._now: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None, None, None]:
        """What a fixture runs may be shared: it counts for every test of the file."""
        return (yield from self._watch(item, _file_of(item.nodeid)))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, None, None]:
        """What the test itself runs."""
        return (yield from self._watch(item, item.nodeid))

    def _watch(self, item: pytest.Item, of: str) -> Generator[None, None, None]:
        self._now = self.reached[of]
        began = time.process_time()
        if self.longest_s < math.inf:
            signal.signal(signal.SIGPROF, lambda *_: self._stop(item))
            signal.setitimer(signal.ITIMER_PROF, self.longest_s)
        try:
            return (yield)
        except Exception:  # whatever a library makes of being stopped
            if math.isfinite(self.cost_s[item.nodeid]):
                raise
            self._stop(item)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            self.cost_s[item.nodeid] += time.process_time() - began

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Leave out a test that is skipped or fails without any mutant, perhaps by a stopped fixture."""
        if report.failed:
            self.failed.append(report.nodeid)
        if not report.passed:
            self.cost_s[report.nodeid] = math.inf

    def _stop(self, item: pytest.Item) -> None:
        self.cost_s[item.nodeid] = math.inf  # it may reach more mutants than were seen
        pytest.skip("costs too much")

    def reach(self, job: str) -> None:
        """Note that the test that runs has come to the statement of a mutant."""
        self._now.add(job)


def with_probes(code: str, lines: Mapping[str, int]) -> ast.Module:
    """Return a module that calls `__probe__` with the name of a mutant before the statement of its line."""
    tree = ast.parse(code)
    for job, line in lines.items():
        for node in ast.walk(tree):  # the innermost statement comes last
            for name in ("body", "orelse", "finalbody"):
                block = getattr(node, name, None)
                for statement in block if isinstance(block, list) else []:
                    if statement.lineno <= line <= statement.end_lineno:
                        around, before = block, statement
        probe = ast.parse(f"__probe__({job!r})").body[0]
        for part in ast.walk(probe):
            ast.copy_location(part, before)
        around.insert(around.index(before), probe)
    return tree


_IMPORTER = """import builtins, contextlib, importlib, sys
reached = set()
builtins.__probe__ = reached.add
for name in sys.argv[1:]:
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
print(*reached)
"""


def module_of(copy: Path, path: Path) -> str:
    """Return the name of the module in a file."""
    return ".".join(path.relative_to(copy / "src").with_suffix("").parts).removesuffix(".__init__")


def import_all(copy: Path) -> None:
    """Import the modules of the package, and all that their functions import.

    A probe needs a module's functions, and no test shall have the cost of an import that comes late.
    """
    for path in sorted((copy / SOURCE).rglob("[!_]*.py")):  # not __main__, which runs the program
        names = [module_of(copy, path)]
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        for name in names:
            with contextlib.suppress(ImportError):
                importlib.import_module(name)


def reached_at_import(copy: Path, probed: Mapping[Path, ast.Module]) -> set[str]:
    """Return the mutants whose statements run when their modules are imported, by another interpreter."""
    modules = [module_of(copy, path) for path in probed]
    before = {path: path.read_text("utf-8") for path in probed}
    try:
        for path, tree in probed.items():
            path.write_text(ast.unparse(tree), "utf-8")
        command = [sys.executable, "-B", "-c", _IMPORTER, *modules]
        return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    finally:
        for path, code in before.items():
            path.write_text(code, "utf-8")


def _file_of(test: str) -> str:
    return test.partition("::")[0]


class Session:
    """Plugin of pytest that collects and then does some work instead of running the tests."""

    def __init__(self, work: Callable[[pytest.Session], None]) -> None:
        self.work = work

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Work."""
        self.work(session)
        return True


def fails(session: pytest.Session, items: list[pytest.Item]) -> int:
    """Run tests until the first fails; 1 if one did."""
    for item, after in itertools.zip_longest(items, items[1:]):
        item.ihook.pytest_runtest_protocol(item=item, nextitem=after)
        if session.testsfailed:
            return 1
    return 0


def chosen(watch: Watch, job: str, imported: bool, longest_s: float) -> list[str]:
    """Tests that reach a mutant, the cheapest first; all if it runs at import."""
    reached = watch.reached
    return sorted(
        (
            test
            for test, cost_s in watch.cost_s.items()
            if math.isfinite(cost_s)
            and cost_s <= longest_s
            and (imported or job in reached.get(test, set()) | reached.get(_file_of(test), set()))
        ),
        key=lambda test: watch.cost_s[test],
    )


def at_import(tree: ast.Module, line: int) -> bool:
    """Whether a line runs when its module is imported: it is in no function's body."""
    return not any(
        isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body[0].lineno <= line <= (node.end_lineno or line)
        for node in ast.walk(tree)
    )


class Child:
    """Some work in a forked process, ended if it takes more than `limit_s` of processor time.

    Processor time, since on a busy machine the clock would kill mutants that nothing is wrong with. What
    waits forever needs none: it is ended after fifty times that on the clock.
    """

    def __init__(self, work: Callable[[], int], limit_s: float, output: Path) -> None:
        self.output = output
        self.ends = time.monotonic() + 50 * limit_s
        self._over = False
        self._status: int | None = None
        self.pid = os.fork()
        if not self.pid:
            os.setsid()
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(limit_s), math.ceil(limit_s) + 1))
            with output.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            status = 99
            try:
                status = work()
            except Exception:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)

    def over(self) -> bool:
        """Whether it has ended, by itself or because it took too long."""
        if self._over:
            return True
        late = time.monotonic() > self.ends
        if late:
            os.killpg(self.pid, signal.SIGKILL)
        done, status = os.waitpid(self.pid, 0 if late else os.WNOHANG)
        self._over = bool(done)
        if done and not os.WIFSIGNALED(status):
            self._status = os.waitstatus_to_exitcode(status)
        return self._over

    def status(self) -> int | None:
        """Exit status, once it has ended; None if it took too long."""
        while not self.over():
            time.sleep(0.02)
        return self._status

    def text(self) -> str:
        """What it printed."""
        return self.output.read_text(errors="replace")


def collected(room: Room, work: Callable[[pytest.Session], None]) -> None:
    """Have pytest collect a room's tests and do some work; hypothesis draws the same examples each time."""
    with contextlib.redirect_stdout(sys.stderr):
        status = pytest.main([*ARGUMENTS, "-s", *room.tests], plugins=[Session(work)])
    if status not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise SystemExit(f"the tests of this room cannot be collected: {status!r}")


def lines_of_functions(copy: Path, items: Sequence[WorkItem]) -> dict[Path, dict[str, int]]:
    """Lines of the mutants in bodies of functions, by file and mutant."""
    lines: dict[Path, dict[str, int]] = defaultdict(dict)
    for item in items:
        (mutant,) = item.mutations
        path = copy / mutant.module_path
        if not at_import(ast.parse(path.read_text("utf-8")), mutant.start_pos[0]):
            lines[path][item.job_id] = mutant.start_pos[0]
    return lines


def watched(
    session: pytest.Session, copy: Path, items: Sequence[WorkItem], notes: Path, options: argparse.Namespace
) -> Watch:
    """What the tests of a room cost and which mutants they reach, on the code as it is. Once a session."""
    watch = Watch(options.longest)
    files = list(dict.fromkeys(_file_of(item.nodeid) for item in session.items))
    lines = lines_of_functions(copy, items)
    probed = {path: with_probes(path.read_text("utf-8"), jobs) for path, jobs in lines.items()}
    import_all(copy)

    def work(share: int) -> int:
        session.config.pluginmanager.register(watch)
        vars(builtins)["__probe__"] = watch.reach
        for path, tree in probed.items():
            for job in lines[path].keys() - watch.imported:
                with contextlib.suppress(RuntimeError, ValueError):
                    exchange(path, tree, lines[path][job])
        mine = [
            item for item in session.items if files.index(_file_of(item.nodeid)) % options.jobs == share
        ]
        for item, after in itertools.zip_longest(mine, mine[1:]):
            item.ihook.pytest_runtest_protocol(item=item, nextitem=after)
        part(share).write_bytes(pickle.dumps((dict(watch.cost_s), dict(watch.reached))))
        print("".join(f"{NOT_ASKED}{name}\n" for name in watch.failed))
        return 0

    def part(share: int) -> Path:
        return copy.parent / f"notes{share}"

    if not notes.exists():
        watch.imported = reached_at_import(copy, probed)
        children = [
            Child(lambda share=share: work(share), 3600, copy.parent / f"output{share}.txt")
            for share in range(options.jobs)
        ]
        for child in children:
            if child.status() != 0:
                raise SystemExit(f"the tests cannot be run:\n{child.text()[-3000:]}")
            not_asked = [line for line in child.text().splitlines(keepends=True) if NOT_ASKED in line]
            print("".join(not_asked), file=sys.stderr, flush=True)
        costs, reached = {}, {}
        for share in range(options.jobs):
            more_costs, more = pickle.loads(part(share).read_bytes())
            costs.update(more_costs)
            reached.update(more)
        notes.write_bytes(pickle.dumps((costs, reached, watch.imported)))
    costs, reached, watch.imported = pickle.loads(notes.read_bytes())
    watch.cost_s.update(costs)
    watch.reached.update(reached)
    return watch


def code_of(tree: ast.Module, file: str, line: int) -> CodeType:
    """Code, in some module, of the outermost function that a line belongs to."""
    outermost = next(
        node
        for node in _outermost(tree)
        if node.body[0].lineno <= line <= (node.end_lineno or line)
    )  # fmt: skip
    first = min([outermost.lineno, *(d.lineno for d in outermost.decorator_list)])
    waiting = [compile(tree, file, "exec")]
    while True:
        for constant in waiting.pop().co_consts:
            if isinstance(constant, CodeType):
                if constant.co_name == outermost.name and constant.co_firstlineno == first:
                    return constant
                waiting.append(constant)


def _outermost(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Functions of a module and of its classes, without those inside of functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
        else:
            yield from _outermost(node)


def exchange(path: Path, changed: ast.Module, line: int) -> None:
    """Give a function that has been imported the code that it has in a changed module."""
    code = code_of(changed, str(path), line)
    gc.unfreeze()  # the tests' conftest hides what was imported from the collector
    now = [
        function
        for function in gc.get_objects()
        if isinstance(function, FunctionType)
        and function.__code__.co_filename == str(path)
        and function.__code__.co_firstlineno == code.co_firstlineno
        and function.__code__.co_name == code.co_name
    ]
    if not now:
        raise RuntimeError(f"{path}: no function {code.co_name} at line {code.co_firstlineno}")
    for function in now:
        function.__code__ = code


class Trial:
    """A mutant under the tests that run its lines.

    What stands in a function's body takes the place of the function's code in a forked process, and any
    number of such trials may run at a time. What runs at import is imported by another interpreter from the
    changed file: such a trial is alone.
    """

    def __init__(
        self, session: pytest.Session, copy: Path, watch: Watch, longest_s: float, item: WorkItem
    ) -> None:
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        (mutant,) = item.mutations
        self.path = copy / mutant.module_path
        self.line = mutant.start_pos[0]
        self.before = self.path.read_text("utf-8")
        after = mutate_code(self.before, get_operator(mutant.operator_name)(), mutant.occurrence)
        assert after is not None
        self.after = after
        self.alone = item.job_id in watch.imported or at_import(ast.parse(self.before), self.line)
        self.tests = chosen(watch, item.job_id, self.alone, longest_s)
        self.limit_s = 20 + 3 * sum(watch.cost_s[test] for test in self.tests)
        self.items = {item.nodeid: item for item in session.items}
        self.session = session
        self.child: Child | None = None

    def start(self, output: Path) -> None:
        """Begin; `result` waits for the end."""
        self.began = time.monotonic()
        if not self.tests:
            return
        if self.alone:
            self.path.write_text(self.after, "utf-8")
        self.child = Child(self._work, self.limit_s, output)

    def _work(self) -> int:
        if self.alone:
            os.execv(sys.executable, [sys.executable, "-B", "-m", "pytest", "-x", *ARGUMENTS, *self.tests])
        try:
            exchange(self.path, ast.parse(self.after), self.line)
        except (RuntimeError, ValueError):
            return NOT_EXCHANGED
        return fails(self.session, [self.items[test] for test in self.tests])

    def result(self) -> WorkResult:
        """What became of it."""
        from cosmic_ray.work_item import TestOutcome, WorkerOutcome, WorkResult

        status, text = 0, "no test runs the line\n"
        if self.child is not None:
            status = self.child.status()
            if status == NOT_EXCHANGED:  # by another interpreter then
                self.alone = True
                self.path.write_text(self.after, "utf-8")
                self.child = Child(self._work, self.limit_s, self.child.output)
                status = self.child.status()
            text = "timeout" if status is None else self.child.text()
        if self.alone:
            self.path.write_text(self.before, "utf-8")
        old, new = self.before.splitlines(), self.after.splitlines()
        return WorkResult(
            WorkerOutcome.NORMAL,
            output=text,
            test_outcome=TestOutcome.SURVIVED if status == 0 else TestOutcome.KILLED,
            diff="\n".join(difflib.unified_diff(old, new, lineterm="", n=0)),
        )


def run(
    name: str, copy: Path, session: Path, options: argparse.Namespace
) -> list[tuple[WorkItem, WorkResult]]:
    """Draw the mutants of a room, or take up those of a session, and run what has no result yet."""
    from cosmic_ray.work_db import WorkDB, use_db
    from cosmic_ray.work_item import WorkItem

    room = ROOMS[name]
    with use_db(session, WorkDB.Mode.create) as base:
        if not base.num_work_items:
            drawn = draw(copy, room, options.mutants, random.Random(f"{options.seed} {name}"))
            base.add_work_items(WorkItem.single(uuid.uuid4().hex, mutant) for mutant in drawn)
        pending = list(base.pending_work_items)

        def work(tests: pytest.Session) -> None:
            import adis_gonio

            if not Path(adis_gonio.__file__).is_relative_to(copy):
                raise SystemExit(f"the tests ran on {adis_gonio.__file__}, not on the copy")
            watch = watched(tests, copy, base.work_items, session.with_suffix(".notes"), options)
            ends = time.monotonic() + 60 * options.minutes
            running: list[tuple[WorkItem, Trial]] = []
            for number, item in enumerate(pending):
                trial = Trial(tests, copy, watch, options.longest, item)
                while running and (trial.alone or running[0][1].alone or len(running) >= options.jobs):
                    finish(*running.pop(_first_over(running)))
                if time.monotonic() > ends:
                    break
                trial.start(copy.parent / f"output{number}.txt")
                running.append((item, trial))
            while running:
                finish(*running.pop(_first_over(running)))

        def finish(item: WorkItem, trial: Trial) -> None:
            result = trial.result()
            base.set_result(item.job_id, result)
            print(
                f"{base.num_results}/{base.num_work_items} {where_is(item)} {outcome(result)}"
                f" after {time.monotonic() - trial.began:.0f} s",
                file=sys.stderr,
                flush=True,
            )

        if pending:
            collected(room, work)
        results = dict(base.results)
        return [(item, results[item.job_id]) for item in base.work_items if item.job_id in results]


def _first_over(running: Sequence[tuple[WorkItem, Trial]]) -> int:
    """Place of the first trial to end."""
    while True:
        for place, (_, trial) in enumerate(running):
            if trial.child is None or trial.child.over():
                return place
        time.sleep(0.02)


def where_is(item: WorkItem) -> str:
    """File and line of a mutant."""
    (mutant,) = item.mutations
    return f"{mutant.module_path}:{mutant.start_pos[0]}"


def outcome(result: WorkResult) -> str:
    """What became of a mutant."""
    if result.test_outcome == "survived":
        return "survived"
    return "timed out" if result.output == "timeout" else "killed"


def wilson(hits: int, of: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a share."""
    centre = (hits + z * z / 2) / (of + z * z)
    half = z / (of + z * z) * math.sqrt(hits * (of - hits) / of + z * z / 4)
    return centre - half, centre + half


def main() -> None:
    """Run the rooms that were asked for and print what survived."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--room", choices=[*ROOMS, "all"], default="all")
    parser.add_argument("--mutants", type=int, default=60, help="sample of each room")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--minutes",
        type=float,
        default=math.inf,
        help="for the mutants of a room; those done are the sample",
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--longest",
        type=float,
        default=math.inf,
        metavar="S",
        help="leave out tests that cost more processor time: quicker, and the score a lower bound",
    )
    parser.add_argument("--session", type=Path, help="database to keep the results in, or to go on with")
    options = parser.parse_args()
    if options.mutants < 1 or options.jobs < 1:
        parser.error("--mutants and --jobs have to be at least 1")
    try:
        import cosmic_ray.mutating  # noqa: F401
    except ImportError:
        raise SystemExit("cosmic-ray is not installed: pip install cosmic-ray") from None
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's `&` and nohup ignore it
    session = options.session.resolve() if options.session else None
    names = list(ROOMS) if options.room == "all" else [options.room]
    tables, survivors = [], []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, contextlib.chdir(folder):
        copy = copy_of(ROOT, Path(folder).resolve() / ROOT.name)
        os.chdir(copy)
        sys.path.insert(0, str(copy / "src"))
        os.environ["PYTHONPATH"] = str(copy / "src")  # for what tests start
        sys.dont_write_bytecode = True
        for name in names:
            place = session or Path(folder) / "session.sqlite"
            place = place.with_stem(f"{place.stem}-{name}")
            done = run(name, copy, place, options)
            counts = dict.fromkeys(("killed", "timed out", "survived"), 0)
            for item, result in done:
                counts[outcome(result)] += 1
                if outcome(result) == "survived":
                    survivors.append((where_is(item), result.diff))
            if not done:
                continue
            caught = len(done) - counts["survived"]
            low, high = wilson(caught, len(done))
            tables.append(
                f"{name:<12}{len(done):>8}" + "".join(f"{n:>10}" for n in counts.values())
                + f"{caught / len(done):>8.0%}  ({low:.0%} to {high:.0%})"
            )  # fmt: skip
    for where, diff in survivors:
        print(f"\n{where}")
        changed = [
            line for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")
        ]
        print("\n".join(f"    {line}" for line in changed))
    print(f"\n{'room':<12}{'mutants':>8}{'killed':>10}{'timed out':>10}{'survived':>10}{'score':>8}")
    print("\n".join(tables))


if __name__ == "__main__":
    main()
