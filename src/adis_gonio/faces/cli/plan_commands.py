"""The commands `plan`, `template` and `simulate`: a session before it is measured."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import click

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import counted, use_minus, with_unit
from adis_gonio.base.output import ends_in, replacing
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import print_json, report_progress, report_written, say
from adis_gonio.model.records import SENSORS, STANDARD_GRAVITY_MPS2

if TYPE_CHECKING:
    from adis_gonio.base.conformity import Tolerance
    from adis_gonio.plan.optimal_plan import BestPlan
    from adis_gonio.plan.prediction import Bench


@option.command(
    "plan",
    "--fixture --positions --output",
    {
        "Search": "--minutes --best --beware --grid --start --seed",
        "Conformity": "--tolerance --rule --risk",
        "Evaluation of a given plan": "--plan --check",
        "Sensor and place": "--sensor --noise --flicker --gravity",
    },
)
@option.fixture(required=True)
@click.option(
    "--noise", "noise_mg", type=float, metavar="MG",
    help="White noise of a sample in mg rms, without the chip's filter (default: the variant's figure).",
)  # fmt: skip
@click.option(
    "--flicker", "flicker_mg", type=float, metavar="MG",
    help="Minimum of the Allan deviation in mg (default: the variant's figure).",
)  # fmt: skip
@option.positions
@option.tolerance("Find the fewest positions that can decide if the angle error is within this tolerance.")
@click.option(
    "--minutes", type=float, metavar="MINUTES", help="Take as many positions as fit into this time."
)
@click.option(
    "--beware", metavar="EFFECT[,EFFECT…]", default="",
    help="Possible effects, which the plan fits or distinguishes (simulate --list-effects).",
)  # fmt: skip
@click.option(
    "--best", type=click.Choice(["angle", "parameters", "tell-apart"]),
    help="Criterion of the search (default: tell-apart with --beware, else angle).",
)  # fmt: skip
@click.option("--plan", "plan_name", metavar="NAME|FILE", help="Evaluate this plan instead of a search.")
@option.check
@option.with_default(
    "--grid", "grid_deg", type=float, default=5.0, metavar="DEGREES", help="Step of the searched angles."
)
@option.with_default(
    "--start", "start_deg", type=float, default=0.0, metavar="DEGREES",
    help="Angle of the part at the stage's zero, as far as it is known.",
)  # fmt: skip
@option.dwell()
@option.settle
@option.rate
@option.filter
@option.gravity(default=STANDARD_GRAVITY_MPS2)
@option.with_default("--sensor", default="adis16354", help="adis16354, adis16350 or adis16355.")
@option.seed(1, "Seed of the search.")
@option.output("Plan file to write, for calibrate --plan FILE.")
@option.json
def plan_command(
    *, output: Path | None, as_json: bool, tolerance: Tolerance | None, **options: Any
) -> None:
    """Predict the uncertainties and detectable effects of a plan of positions, or find the best plan.

    Give one of --positions, --tolerance and --minutes to search for the best plan, including the order of
    its positions and the side from which each is approached. Give --plan to evaluate a plan by its name or
    file.

    calibrate, simulate and template take the plan file of -o as --plan FILE.
    """
    from adis_gonio.plan import find_plan
    from adis_gonio.plan.optimal_plan import prediction_lines
    from adis_gonio.plan.prediction import Bench, predict
    from adis_gonio.record.plans import document_of, write_plan

    if output is not None and not ends_in(output, ".json"):
        raise UsageError(f"{output}: a plan is a JSON file: name it .json")
    bench_options = ("fixture_deg", "sensor", "noise_mg", "flicker_mg", "start_deg")
    measuring = ("dwell_s", "settle_s", "rate_hz", "filter_m")
    bench = Bench(
        **{name: options[name] for name in bench_options},
        gravity_mps2=options["gravity_mps2"],
        settings=option.measuring_settings(**{name: options[name] for name in measuring}),
    )
    found: BestPlan | None = None
    if options["plan_name"] is not None:
        option.refuse(("minutes", "best", "beware"), "--plan evaluates a plan as it is")
        plan = find_plan(options["plan_name"], options["positions"], options["check"])
        prediction = predict(plan, bench)
    else:
        with report_progress("searching for the best plan"):
            found = _search(bench, tolerance, options)
        prediction = found.prediction
    if output is not None:
        write_plan(output, prediction.plan, None if found is None else found.made_for())
        report_written(output, counted(len(prediction.plan), "position"))
    if as_json:
        stated = {} if tolerance is None else {"conformity": prediction.reach.conformity(tolerance)}
        shown = (found or prediction).as_dict()
        print_json({"plan": document_of(prediction.plan), **shown, **json_object(**stated)})
        return
    for line in prediction_lines(prediction, found, tolerance):
        click.echo(line)
    if output is not None:
        dwell = f" --dwell {options['dwell_s']:g}"
        click.echo(f"next: adis-gonio calibrate URL --plan {output}{dwell} -o NAME.session")


def _search(bench: Bench, tolerance: Tolerance | None, options: dict[str, Any]) -> BestPlan:
    from adis_gonio.plan.optimal_plan import best_plan, fewest_positions, positions_in

    count, minutes = options["positions"], options["minutes"]
    given = [value for value in (count, minutes) if value is not None]
    if len(given) > 1 or not (given or tolerance):
        raise UsageError("give one of --positions, --tolerance and --minutes, or --plan to evaluate one")
    option.refuse(("check",), "goes with --plan; calibrate --plan FILE --check adds them to a plan file")
    names = tuple(name.strip() for name in options["beware"].split(",") if name.strip())
    best: Any = options["best"] or ("tell-apart" if names else "angle")
    grid = {name: options[name] for name in ("grid_deg", "seed")}
    if tolerance is not None and not given:
        return fewest_positions(bench, tolerance, best, names, **grid)
    count = positions_in(bench, minutes) if count is None else count
    return best_plan(bench, count, best, names, **grid)


@option.command(
    "template",
    "--output --plan --unit",
    {"Plan": "--positions --check", "Keys of the file": "--gravity --fixture --sensor"},
)
@option.with_default(
    "--plan", "plan_name", default="two-position",
    help="two-position, four-position, mmpm, tumble, poses, or a plan file.",
)  # fmt: skip
@option.positions
@option.check
@option.output("CSV file to write.", required=True)
@option.with_default(
    "--sensor", type=click.Choice(SENSORS), default=SENSORS[0], help="Sensor of the readings."
)
@option.with_default(
    "--unit", "accel_unit", type=option.parse_unit, metavar=option.UNITS, default="mg",
    help="Unit of the accelerations.",
)  # fmt: skip
@option.gravity("Local gravity in m/s².", default=STANDARD_GRAVITY_MPS2, show_default=True)
@option.fixture("fixture_sigma_deg")
def template_command(
    *, plan_name: str, positions: int | None, check: int, output: Path, **keys: Any
) -> None:
    """Write an empty samples file to fill in: keys with their meaning, one row per position of the plan.

    Fill in times and readings in an editor or a spreadsheet; `adis-gonio fit` reads the saved file.
    """
    from adis_gonio.base.output import write_text
    from adis_gonio.plan import find_plan
    from adis_gonio.record.samples_writer import template_text

    if ends_in(output, ".gz"):
        raise UsageError(f"{output}: a template is filled in by hand: name it .csv")
    chosen = find_plan(plan_name, positions, check)
    write_text(output, template_text(chosen, **keys))
    report_written(output, f"{counted(len(chosen), 'position')} to fill in")


def _list_option(name: str, rows: Callable[[], list[tuple[str, str]]], help: str) -> option.Option[Any]:
    """Return the option `name`, which prints a list and ends the program without running the command.

    `rows` returns the name and the description of each entry; `help` is the help text of the option.
    """

    def print_list(context: click.Context, option: click.Parameter, wanted: bool) -> None:
        if wanted:
            formatter = click.HelpFormatter(max_width=context.max_content_width)
            formatter.write_dl(rows(), col_max=26)
            click.echo(formatter.getvalue(), nl=False)
            context.exit()

    return click.option(
        name, is_flag=True, expose_value=False, is_eager=True, callback=print_list, help=help
    )


def _effect_rows() -> list[tuple[str, str]]:
    from adis_gonio.model.effects import catalogue

    return [(name, effect.cause) for name, effect in catalogue().items()]


def _setting_rows() -> list[tuple[str, str]]:
    from adis_gonio.sim.settings import described_settings

    return described_settings()


@option.command(
    "simulate",
    "--output --plan --effect",
    {
        "Plan": "--positions --check",
        "Simulated bench": "--set --date --serial --seed --sensor --like --list-effects --list-settings",
    },
)
@option.output(
    "File to write: .csv or .csv.gz for samples without the truth, else a session file with the truth.",
    required=True,
)  # fmt: skip
@option.with_default("--plan", "plan_name", default="four-position", help="A plan by name, or a plan file.")
@option.positions
@option.check
@option.seed()
@option.variant
@click.option(
    "--effect", "effects", multiple=True, metavar="NAME[:PARAMETER=VALUE,…]",
    help="An effect of the catalogue, such as quadratic:k2_x=2.5; may be repeated.",
)  # fmt: skip
@click.option(
    "--set", "settings", multiple=True, metavar="NAME=VALUE",
    help="A setting of the simulated world, such as delta_k=0.01; may be repeated.",
)  # fmt: skip
@click.option(
    "--date", type=click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M"]), metavar="DATE",
    help="Date of the session, such as 2024-05-31 (UTC; default: now): another date gives the same part"
    " other noise. CSV keeps no date.",
)  # fmt: skip
@click.option("--serial", default="", help="Serial number of the part.")
@option.dwell()
@option.rate
@option.filter
@option.title
@option.file(
    "--like", metavar="SESSION",
    help="Simulate a session's digital twin: its traced model, noise, positions and times; to .csv[.gz].",
)  # fmt: skip
@_list_option("--list-effects", _effect_rows, "List the effects with their causes.")
@_list_option("--list-settings", _setting_rows, "List the settings with their defaults.")
def simulate_command(*, output: Path, date: datetime | None, **options: Any) -> None:
    """Record a session from the simulated sensor, with hidden parameters and effects by name.

    The driver measures the session frame by frame, like a session from a real sensor.
    """
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor import open_sensor
    from adis_gonio.faces.cli.line_prompts import PlainBench
    from adis_gonio.plan import find_plan
    from adis_gonio.record.archive import ArchiveView
    from adis_gonio.record.loading import load_session
    from adis_gonio.record.samples_writer import write_samples_csv

    as_csv = ends_in(output, ".csv", ".csv.gz")
    if not as_csv:
        option.check_session_name(output)
    if options["like"] is not None:
        _simulate_twin(options["like"], output, options["seed"])
        return
    settings = option.measuring_settings(
        **{name: options[name] for name in ("dwell_s", "rate_hz", "filter_m")}
    )
    positions = find_plan(options["plan_name"], options["positions"], options["check"])
    _report_effects(options["effects"])
    with (
        tempfile.TemporaryDirectory() as folder,
        open_sensor(_simulator_url(date, **options), variant=options["variant"]) as sensor,
    ):
        archive = Path(folder) / "simulated.session" if as_csv else output
        world = sensor.bus.world  # type: ignore[attr-defined]  # the simulator's bus has one
        if archive.is_file():
            archive.unlink()
        runner = SessionRunner.begin(
            sensor,
            archive,
            positions,
            settings,
            auto=True,
            gravity_mps2=world.settings.gravity_mps2,
            fixture_sigma_deg=world.settings.fixture_sigma_deg,
            title=options["title"],
            serial=options["serial"],
            created_utc="" if date is None else date.replace(tzinfo=UTC).isoformat(),
        )
        complete = PlainBench(runner, auto=True).run()
        with ArchiveView(archive) as view:
            done = len(view.dwells())
        if as_csv and done:
            with replacing(output) as temporary:
                write_samples_csv(load_session(archive), temporary)
    if not complete:  # only Ctrl-C ends a simulation early
        say(f"{output}: {done} of {counted(len(positions), 'dwell')}")
        raise KeyboardInterrupt
    report_written(output, counted(done, "dwell"))


def _report_effects(effects: Sequence[str]) -> None:
    """Print the size of each simulated effect; an effect without values has its typical size."""
    from adis_gonio.model.effects import parse_effect

    for effect, values in map(parse_effect, effects):
        sizes = (
            f"{one.name} {with_unit(use_minus(f'{value:g}'), one.unit)}"
            for one, value in zip(effect.parameters, values.tolist(), strict=True)
        )
        say(f"effect {effect.name}: {', '.join(sizes)}")


def _simulate_twin(path: Path, output: Path, seed: int) -> None:
    """Simulate a session with the parameters and effects that a trace finds in the session at `path`.

    This digital twin is written as a samples CSV. `seed` is the seed of its random numbers.
    """
    from adis_gonio.base.budget import current
    from adis_gonio.handover.digital_twin import simulate_like
    from adis_gonio.record.loading import explain_refusal, load_session
    from adis_gonio.record.samples_writer import write_samples_csv
    from adis_gonio.tracing.trace import trace

    if not ends_in(output, ".csv", ".csv.gz"):
        raise UsageError(f"{output}: --like writes a samples CSV; name it .csv or .csv.gz")
    with report_progress(f"reading {path.name}"):
        try:
            session = load_session(path)
        except DataError as error:
            raise DataError(explain_refusal(str(error))) from None
    with report_progress(f"twin of {counted(len(session.dwells), 'dwell')} of {path.name}"):
        traced = trace(session)
        if not traced.fits:
            raise DataError(f"{path}: one pose has no model of positions to simulate")
        current().tell("simulating")
        twin = simulate_like(session, traced.fits[-1], seed=seed)
    with replacing(output) as temporary:
        write_samples_csv(twin, temporary)
    report_written(output, f"{counted(len(session.dwells), 'dwell')}, the twin of {path}")


def _simulator_url(
    date: datetime | None, *, seed: int, variant: str, effects: tuple[str, ...], settings: tuple[str, ...],
    **_: Any,
) -> str:  # fmt: skip
    pairs = [("seed", str(seed)), ("variant", variant)]
    if date is not None:  # another session of the same part, with noise of its own
        pairs.insert(1, ("day", f"{date:%Y%m%d%H%M}"))
    if effects:
        pairs.append(("effects", ";".join(effects)))
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise UsageError(f"--set {text}: write NAME=VALUE, such as delta_k=0.01")
        pairs.append((name, value))
    return "sim:?" + "&".join(f"{name}={quote(value, safe=':=,;.')}" for name, value in pairs)
