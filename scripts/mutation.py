"""Changes that the tests should notice: a random sample of mutants, room by room.

    pip install cosmic-ray                  # operators and session database; needed by nothing else
    python scripts/mutation.py --room wire --mutants 60 --seed 1
    python scripts/mutation.py --room all --mutants 40 --seed 2 --session build/mutants.sqlite

Each mutant is one small change of one line (cosmic-ray's operators: another operator, comparison or
number, a condition turned round, a loop that does not run, …). It is killed if a test of its room fails or
exceeds the time-out, and has survived if all pass. Only tests that run the line are asked (all of them
where it runs at import), the cheapest first. Everything happens in a copy in a temporary folder.

The draw takes as many different lines as there are, uniformly, before any line comes twice, and on a
line a place and one of the place's mutants. Not drawn, since no behaviour hangs on them: annotations,
type aliases, `__all__`, texts of errors, warnings and log, flags that guard only against the programmer
(`strict` of zip, `frozen` and `slots` of a dataclass), decorators that only cache, generated files (a test
compares them with their source), and mutants that do not compile. Docstrings have no mutants.

Printed: every survivor with file, line and difference; then per room mutants, killed, timed out, survived,
score (share that did not survive) and its 95 % interval (Wilson). A survivor is either *equivalent* (no
input could tell) or a missing test; which of the two only a reader can say, so the score counts both.

With `--session` the work is kept in a database of cosmic-ray (one a room: the room's name is added) and an
interrupted run goes on where it stopped; `cr-report` and `cr-html` read it too.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import importlib
import math
import os
import pickle
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import uuid
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from cosmic_ray.work_item import MutationSpec, WorkItem, WorkResult

ROOT = Path(__file__).resolve().parents[1]
SOURCE = "src/adis_gonio"
UNNOTICED = {int(pytest.ExitCode.OK), int(pytest.ExitCode.NO_TESTS_COLLECTED)}


@dataclass(frozen=True)
class Room:
    """Folders of `src/adis_gonio` and the tests that belong to them, the quick ones first."""

    folders: tuple[str, ...]
    tests: tuple[str, ...]
    generated: tuple[str, ...] = ()


ROOMS = {
    "wire": Room(
        ("bus/wire",),
        ("tests/wire/test_wire_codec.py",),
        generated=("bus/wire/protocol.py",),
    ),
    "sensor": Room(
        ("sensor",),
        (
            "tests/sensor/test_register_table.py",
            "tests/sensor/test_frames_and_decoding.py",
            "tests/sensor/test_driver.py",
            "tests/sensor/test_data_ready.py",
        ),
    ),
    "estimation": Room(
        ("estimation", "fitting"),
        (
            "tests/estimation/test_clipping.py",
            "tests/estimation/test_other_measurements.py",
            "tests/fitting/test_flicker.py",
            "tests/fitting/test_readings.py",
            "tests/fitting/test_shared_noise.py",
            "tests/fitting/test_ml_against_full_least_squares.py",
            "tests/fitting/test_methods.py",
            "--deselect=tests/fitting/test_methods.py::test_covariance_is_the_scatter_of_the_estimates",
        ),
    ),
    "tracing": Room(
        ("tracing",),
        (
            "tests/tracing/test_trace_engine.py",
            "tests/tracing/test_trace_gates.py",
        ),
    ),
}

Place = tuple[int, int]  # line from 1, column from 0, in characters
Line = tuple[str, int]


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
        yield from (d for d in node.decorator_list if _name(d) in {"cache", "lru_cache"})


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
    files = [path for folder in room.folders for path in sorted((copy / SOURCE / folder).rglob("*.py"))]
    for path in files:
        name = str(path.relative_to(copy))
        if name in {f"{SOURCE}/{generated}" for generated in room.generated}:
            continue
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
    """Plugin of pytest that notes what each test costs and which lines of some files it runs."""

    def __init__(self, names: dict[str, str]) -> None:
        self.names = names  # of the files as the mutants have them, by their paths
        self.cost_s: dict[str, float] = defaultdict(float)
        self.lines: dict[str, set[Line]] = defaultdict(set)
        self._now: set[Line] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None, None, None]:
        """What a fixture runs may be shared: it counts for every test of the file."""
        return (yield from self._watch(item, _file_of(item)))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, None, None]:
        """What the test itself runs."""
        return (yield from self._watch(item, item.nodeid))

    def _watch(self, item: pytest.Item, of: str) -> Generator[None, None, None]:
        self._now = self.lines[of]
        began = time.process_time()
        threading.settrace(self._enter)
        sys.settrace(self._enter)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]
            self.cost_s[item.nodeid] += time.process_time() - began

    def _enter(self, frame: FrameType, event: str, argument: object) -> Any:
        return self._line if frame.f_code.co_filename in self.names else None

    def _line(self, frame: FrameType, event: str, argument: object) -> Any:
        self._now.add((self.names[frame.f_code.co_filename], frame.f_lineno))
        return self._line


def _file_of(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


class Choose:
    """Plugin of pytest that keeps the tests that run one of some lines, the cheapest first.

    Where no test runs them, as at import, all are kept; never one that costs more than `longest_s`.
    """

    def __init__(self, watch: Watch, lines: set[Line], longest_s: float) -> None:
        self.watch = watch
        self.wanted = lines
        self.longest_s = longest_s

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Choose and sort."""
        ran = self.watch.lines
        everywhere = not any(self.wanted & lines for lines in ran.values())
        items[:] = [
            item
            for item in items
            if self.watch.cost_s[item.nodeid] <= self.longest_s
            and (everywhere or self.wanted & ran[item.nodeid] or self.wanted & ran[_file_of(item)])
        ]
        items.sort(key=lambda item: self.watch.cost_s[item.nodeid])


def in_a_child(work: Callable[[], int], limit_s: float, output: Path) -> int | None:
    """Exit status of some work in a forked process; None if it took more than `limit_s` of processor time.

    Processor time, since on a busy machine the clock would kill mutants that nothing is wrong with. What
    waits forever needs none: it is ended after fifty times that on the clock.
    """
    child = os.fork()
    if not child:
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
    ends = time.monotonic() + 50 * limit_s
    while time.monotonic() < ends:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return None if os.WIFSIGNALED(status) else os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def pytest_in(room: Room, plugin: object) -> int:
    """Run the tests of a room in this process; hypothesis draws the same examples every time."""
    arguments = ["-xq", "--no-header", "--tb=line", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
    loaded = [
        "-W",
        "ignore::pytest.PytestAssertRewriteWarning",
    ]  # libraries are imported before pytest begins
    return int(pytest.main([*arguments, *loaded, *room.tests], plugins=[plugin]))


def watched(copy: Path, room: Room, notes: Path) -> Watch:
    """What the tests of a room cost and run on the code as it is; they must pass. Once a session."""
    paths = (path for folder in room.folders for path in (copy / SOURCE / folder).rglob("*.py"))
    names = {str(path): str(path.relative_to(copy)) for path in paths}
    output = copy.parent / "output.txt"

    def work() -> int:
        sys.dont_write_bytecode = False  # of the code as it is: a mutant's file is younger than this
        watch = Watch(names)
        status = pytest_in(room, watch)
        import adis_gonio

        if not Path(adis_gonio.__file__).is_relative_to(copy):
            print(f"the tests ran on {adis_gonio.__file__}, not on the copy")
            return 1
        libraries = [name for name, module in sys.modules.items() if _outside(module, copy)]
        notes.write_bytes(pickle.dumps((dict(watch.cost_s), dict(watch.lines), libraries)))
        return status

    if not notes.exists() and in_a_child(work, 3600, output) != 0:
        raise SystemExit(f"the tests fail without any mutant:\n{output.read_text()[-3000:]}")
    watch = Watch(names)
    costs, lines, libraries = pickle.loads(notes.read_bytes())
    watch.cost_s.update(costs)
    watch.lines.update(lines)
    for library in libraries:  # once here, and not in the process of every mutant
        with contextlib.suppress(ImportError):
            importlib.import_module(library)
    return watch


def _outside(module: object, copy: Path) -> bool:
    """Whether a module is a library's."""
    file = getattr(module, "__file__", None)
    return bool(file) and "site-packages" in file and not Path(file).is_relative_to(copy)


def tested(copy: Path, room: Room, watch: Watch, longest_s: float, mutant: MutationSpec) -> WorkResult:
    """Run the tests that run a mutant's lines on the mutant."""
    from cosmic_ray.mutating import use_mutation
    from cosmic_ray.plugins import get_operator
    from cosmic_ray.work_item import TestOutcome, WorkerOutcome, WorkResult

    path, output = copy / mutant.module_path, copy.parent / "output.txt"
    lines = {(str(mutant.module_path), line) for line in range(mutant.start_pos[0], mutant.end_pos[0] + 1)}
    limit_s = 20 + 3 * sum(watch.cost_s.values())
    with use_mutation(path, get_operator(mutant.operator_name)(), mutant.occurrence) as (before, after):
        status = in_a_child(lambda: pytest_in(room, Choose(watch, lines, longest_s)), limit_s, output)
    diff = "\n".join(difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0))
    return WorkResult(
        WorkerOutcome.NORMAL,
        output="timeout" if status is None else output.read_text(errors="replace"),
        test_outcome=TestOutcome.SURVIVED if status in UNNOTICED else TestOutcome.KILLED,
        diff=diff,
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
        watch = watched(copy, room, session.with_suffix(".notes")) if pending else None
        ends = time.monotonic() + 60 * options.minutes
        for item in pending:
            if time.monotonic() > ends:
                break
            assert watch is not None
            began = time.monotonic()
            result = tested(copy, room, watch, options.longest, item.mutations[0])
            base.set_result(item.job_id, result)
            print(
                f"{base.num_results}/{base.num_work_items} {where_is(item)} {outcome(result)}"
                f" after {time.monotonic() - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
        results = dict(base.results)
        return [(item, results[item.job_id]) for item in base.work_items if item.job_id in results]


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
        "--minutes", type=float, default=math.inf, help="of each room; what was done by then is the sample"
    )
    parser.add_argument(
        "--longest",
        type=float,
        default=math.inf,
        metavar="S",
        help="leave out tests that cost more processor time: quicker, and the score a lower bound",
    )
    parser.add_argument("--session", type=Path, help="database to keep the results in, or to go on with")
    options = parser.parse_args()
    if options.mutants < 1:
        parser.error("--mutants has to be at least 1")
    try:
        import cosmic_ray.mutating  # noqa: F401
    except ImportError:
        raise SystemExit("cosmic-ray is not installed: pip install cosmic-ray") from None
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
