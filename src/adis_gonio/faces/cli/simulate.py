"""`adis-gonio simulate`: a session from the simulated sensor, recorded like a real one."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import click
import numpy as np

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import working


def _effects() -> None:
    from adis_gonio.model.effects import catalogue

    for name, effect in catalogue().items():
        click.echo(f"{name:<24}{effect.cause}")


def _settings() -> None:
    from dataclasses import fields

    from adis_gonio.sim.settings import WorldSettings

    for entry in fields(WorldSettings):
        default = "drawn from the seed" if entry.default is None else entry.default
        click.echo(f"{entry.name:<32}{default}")


def _list_option(name: str, show: Callable[[], None]) -> option.Option[Any]:
    """Return an option that prints a list in place of the command."""

    def listing(context: click.Context, option: click.Parameter, wanted: bool) -> None:
        if wanted:
            show()
            context.exit()

    return click.option(name, is_flag=True, expose_value=False, is_eager=True, callback=listing)


@click.command("simulate")
@option.output(
    "File to make: .csv or .csv.gz for samples without the truth, else a session file with it.",
    required=True,
)
@option.shown("--plan", "plan_name", default="four-position", help="A plan by name, or a plan file.")
@option.positions
@option.check
@option.shown(
    "--order", type=click.Choice(["plan", "reverse", "shuffled"]), default="plan",
    help="Order in which the positions are visited.",
)  # fmt: skip
@option.shown("--seed", type=int, default=0, help="Seed of all that is random.")
@click.option("--variant", default="adis16354", show_default=True)
@click.option(
    "--effect", "effects", multiple=True, metavar="NAME[:PARAMETER=VALUE,…]",
    help="An effect of the catalogue, such as quadratic:k2_x=2.5; may be repeated (--list-effects).",
)  # fmt: skip
@click.option(
    "--set", "settings", multiple=True, metavar="NAME=VALUE",
    help="A setting of the world, such as delta_k=0.01; may be repeated (--list-settings).",
)  # fmt: skip
@option.dwell()
@option.rate
@option.filter
@option.title
@option.file(
    "--like",
    metavar="SESSION",
    help="Be the digital twin of a session: its traced model, noise, positions and times; to .csv[.gz].",
)
@_list_option("--list-effects", _effects)
@_list_option("--list-settings", _settings)
def command(*, output: Path, **options: Any) -> None:
    """Record a session from the simulated sensor, with hidden parameters and effects by name.

    The session is measured through the driver, frame by frame, as a real one would be.
    """
    from adis_gonio.base.output import check_output
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor import open_sensor
    from adis_gonio.faces.cli.plain import PlainBench
    from adis_gonio.plan.document import plan_by
    from adis_gonio.record.archive import ArchiveView
    from adis_gonio.record.loading import load_session
    from adis_gonio.record.samples_writer import export_csv

    check_output(output, cure="choose another name")
    if options["like"] is not None:
        _twin(options["like"], output, options["seed"])
        return
    settings = option.measuring_settings(
        **{name: options[name] for name in ("dwell_s", "rate_hz", "filter_m")}
    )
    positions = plan_by(options["plan_name"], options["positions"], options["check"])
    positions = positions.ordered(options["order"], np.random.default_rng(options["seed"]))
    as_csv = ends_in(output, ".csv", ".csv.gz")
    with (
        tempfile.TemporaryDirectory() as folder,
        open_sensor(_url(**options), variant=options["variant"]) as sensor,
    ):
        archive = Path(folder) / "simulated.session" if as_csv else output
        world = sensor.bus.world  # type: ignore[attr-defined]  # the simulator's bus has one
        runner = SessionRunner.begin(
            sensor,
            archive,
            positions,
            settings,
            auto=True,
            gravity_mps2=world.settings.gravity_mps2,
            fixture_sigma_deg=world.settings.fixture_sigma_deg,
            title=options["title"],
        )
        complete = PlainBench(runner, auto=True).run()
        with ArchiveView(archive) as view:
            done = len(view.dwells())
        if as_csv and done:
            export_csv(load_session(archive), output)
    if not complete:  # nothing but Ctrl-C ends a simulation early
        click.echo(f"{output}: {done} of {counted(len(positions), 'dwell')}", err=True)
        raise KeyboardInterrupt
    click.echo(f"{output}: {counted(done, 'dwell')}", err=True)


def _twin(path: Path, output: Path, seed: int) -> None:
    """Write the twin of a session."""
    from adis_gonio.base.budget import current
    from adis_gonio.handover.digital_twin import simulate_like
    from adis_gonio.record.loading import explain_refusal, load_session
    from adis_gonio.record.samples_writer import export_csv
    from adis_gonio.tracing.trace import trace

    if not ends_in(output, ".csv", ".csv.gz"):
        raise UsageError(f"{output}: --like writes a samples CSV; name it .csv or .csv.gz")
    with working(f"reading {path.name}"):
        try:
            session = load_session(path)
        except DataError as error:
            raise DataError(explain_refusal(str(error))) from None
    with working(f"twin of {counted(len(session.dwells), 'dwell')} of {path.name}"):
        traced = trace(session)
        if not traced.fits:
            raise DataError(f"{path}: one pose has no model of positions to simulate")
        current().tell("simulating")
        twin = simulate_like(session, traced.fits[-1], seed=seed)
    export_csv(twin, output)
    click.echo(f"{output}: {counted(len(session.dwells), 'dwell')} like those of {path}", err=True)


def _url(*, seed: int, variant: str, effects: tuple[str, ...], settings: tuple[str, ...], **_: Any) -> str:
    pairs = [("seed", str(seed)), ("variant", variant)]
    if effects:
        pairs.append(("effects", ";".join(effects)))
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise UsageError(f"--set {text}: write NAME=VALUE, such as delta_k=0.01")
        pairs.append((name, value))
    return "sim:?" + "&".join(f"{name}={quote(value, safe=':=,;.')}" for name, value in pairs)
