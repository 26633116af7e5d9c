"""`adis-gonio devices`."""

from __future__ import annotations

import click

from adis_gonio.device.bus import find_devices
from adis_gonio.device.bus.host import udev_rules
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import console, print_json, table_of


@click.command("devices")
@click.option("--udev", is_flag=True, help="Print the udev rules that let a user open the bridges.")
@option.json
def command(*, udev: bool, as_json: bool) -> None:
    """List the buses and the devices that are connected, with the URL that opens each.

    A bus that cannot be looked for is a row that says why; the exit status is 0 then too.

    Linux wants a rule before a user may open them: adis-gonio devices --udev | sudo tee
    /etc/udev/rules.d/70-adis-gonio.rules, then plug the device in again.
    """
    if udev:
        click.echo(udev_rules(), nl=False)
        return
    devices = find_devices()
    if as_json:
        print_json({"devices": [device.as_dict() for device in devices]})
        return
    rows = [(device.url, device.description) for device in devices]
    console().print(table_of(("URL", "what it is"), rows, texts=(0, 1)))
