"""`adis-gonio plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.output import ends_in
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import print_json, working

if TYPE_CHECKING:
    from adis_gonio.plan import Bench, BestPlan


@click.command("plan")
@option.fixture(required=True, metavar="DEGREES")
@click.option(
    "--noise", "noise_mg", type=float, metavar="MG",
    help="White noise of a sample, mg rms, without the chip's filter (default: the part's figure).",
)  # fmt: skip
@click.option(
    "--flicker", "flicker_mg", type=float, metavar="MG",
    help="Floor of the Allan deviation, mg (default: the part's figure).",
)  # fmt: skip
@click.option("--positions", type=int, help="How many positions.")
@click.option(
    "--angle-error", "angle_deg", type=float, metavar="DEGREES",
    help="As few positions as keep the angle error (rms over the turn) within this.",
)  # fmt: skip
@click.option("--minutes", type=float, help="As many positions as there is time for.")
@click.option(
    "--beware", metavar="EFFECT[,EFFECT…]", default="",
    help="Effects that there may be: fitted beside, or told apart (simulate --list-effects).",
)  # fmt: skip
@click.option(
    "--best", type=click.Choice(["angle", "parameters", "tell-apart"]),
    help="What the plan is to be best for (default: tell-apart with --beware, else angle).",
)  # fmt: skip
@click.option("--plan", "plan_name", metavar="NAME|FILE", help="Evaluate this plan, search for none.")
@option.shown("--check", type=int, default=0, help="With --plan: positions kept out of the fit.")
@option.shown("--grid", "grid_deg", type=float, default=5.0, help="Angles tried every so many °.")
@option.shown(
    "--start", "start_deg", type=float, default=0.0,
    help="Angle of the part at the stage's zero, degrees, as far as it is known.",
)  # fmt: skip
@option.dwell()
@option.settle
@option.rate
@option.filter
@option.gravity
@option.shown("--sensor", default="adis16354", help="adis16354, adis16350 or adis16355.")
@option.shown("--seed", type=int, default=1, help="Of the search.")
@option.output("Plan file to make, for calibrate --plan FILE.")
@click.option("--force", is_flag=True, help="Replace a plan file that is there.")
@option.json
def command(*, output: Path | None, force: bool, as_json: bool, **options: Any) -> None:
    """Say what a plan of positions will reach, see and tell apart, and find the best one.

    Give one of --positions, --angle-error and --minutes for the best plan of so many positions, in the
    order and from the sides that are best; or --plan to evaluate one by its name or file.

    The plan file that -o makes is taken by calibrate, simulate and template as --plan FILE.
    """
    from adis_gonio.base.output import check_output
    from adis_gonio.plan.document import write_plan
    from adis_gonio.plan.words import lines_of

    if output is not None:
        if not ends_in(output, ".json"):
            raise UsageError(f"{output}: a plan is a JSON file: name it .json")
        check_output(output, force=force)
    bench = _bench(**options)
    found: BestPlan | None = None
    if options["plan_name"] is not None:
        prediction = _given(bench, **options)
    else:
        with working("searching for the best plan"):
            found = _searched(bench, **options)
        prediction = found.prediction
    if output is not None:
        write_plan(output, prediction.plan, None if found is None else found.made_for())
    if as_json:
        from adis_gonio.plan.document import document_of

        told = prediction.as_dict() if found is None else found.as_dict()
        print_json({"plan": document_of(prediction.plan), **told})
        return
    for line in lines_of(prediction, found):
        click.echo(line)
    if output is not None:
        dwell = f" --dwell {options['dwell_s']:g}"
        click.echo(f"next: adis-gonio calibrate URL --plan {output}{dwell} -o NAME.session")


def _bench(*, gravity_mps2: float | None, **options: Any) -> Bench:
    from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
    from adis_gonio.plan import Bench

    bench = ("fixture_deg", "sensor", "noise_mg", "flicker_mg", "start_deg")
    measuring = ("dwell_s", "settle_s", "rate_hz", "filter_m")
    return Bench(
        **{name: options[name] for name in bench},
        gravity_mps2=STANDARD_GRAVITY_MPS2 if gravity_mps2 is None else gravity_mps2,
        settings=option.measuring_settings(**{name: options[name] for name in measuring}),
    )


def _given(bench: Bench, **options: Any) -> Any:
    from adis_gonio.plan import plan_by, predict

    asked = {"--angle-error": "angle_deg", "--minutes": "minutes", "--best": "best"}
    wrong = [name for name, key in asked.items() if options[key] is not None]
    if options["beware"]:
        wrong.append("--beware")
    if wrong:
        raise UsageError(f"--plan evaluates a plan as it is: leave {', '.join(wrong)} out")
    return predict(plan_by(options["plan_name"], options["positions"], options["check"]), bench)


def _searched(
    bench: Bench,
    *,
    positions: int | None,
    angle_deg: float | None,
    minutes: float | None,
    beware: str,
    best: Any,
    grid_deg: float,
    seed: int,
    check: int,
    **_: Any,
) -> BestPlan:
    from adis_gonio.plan import best_plan, fewest, within

    if sum(value is not None for value in (positions, angle_deg, minutes)) != 1:
        raise UsageError("give one of --positions, --angle-error and --minutes, or --plan to evaluate one")
    if check:
        raise UsageError("--check goes with --plan; calibrate --plan FILE --check adds them to a plan file")
    if seed < 0:
        raise UsageError(f"seed is {seed}: take 0 or more")
    names = tuple(name.strip() for name in beware.split(",") if name.strip())
    best = best or ("tell-apart" if names else "angle")
    if angle_deg is not None:
        return fewest(bench, angle_deg, best, names, grid_deg=grid_deg, seed=seed)
    count = within(bench, minutes) if minutes is not None else positions
    assert count is not None  # one of three was given
    return best_plan(bench, count, best, names, grid_deg=grid_deg, seed=seed)
