"""`adis-gonio selftest`."""

from __future__ import annotations

import click

from adis_gonio.device.sensor import open_sensor
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import print_json


@click.command("selftest")
@option.url
@option.variant
@option.no_check
@option.json
def command(*, url: str, variant: str, no_check: bool, as_json: bool) -> int:
    """Run the sensor's internal self-test and say what STATUS reports.

    The outputs are unavailable for 35 ms. Reading STATUS clears it. Exit status 1 where a part failed.
    """
    with open_sensor(url, variant=variant, check=not no_check) as sensor:
        before = sensor.status()
        test = sensor.self_test()
        supply = sensor.quantity("SUPPLY_OUT")
        written = sensor.read("ENDURANCE")
    if as_json:
        print_json(
            {
                "passed": test.passed,
                "failures": test.failures,
                "status_before": before.messages,
                "status_after": test.status.messages,
                "supply_v": supply.value,
                "endurance": written,
            }
        )
    else:
        click.echo(f"self-test    {'passed' if test.passed else 'FAILED: ' + '; '.join(test.failures)}")
        click.echo(f"STATUS       {before} (before)")
        click.echo(f"             {test.status} (after)")
        click.echo(f"supply       {supply.value:.3f} V")
        click.echo(f"flash        written {written} times of 10 000")
    return 0 if test.passed else 1
