"""`adis-gonio devices`."""

from __future__ import annotations

import click

from adis_gonio.bus import find_devices
from adis_gonio.cli.show import console, json_option, print_json


@click.command("devices")
@json_option
def command(*, as_json: bool) -> None:
    """List the buses and the devices that are connected, with the URL that opens each."""
    devices = find_devices()
    if as_json:
        print_json({"devices": [device.as_dict() for device in devices]})
        return
    from rich.table import Table

    table = Table("URL", "what it is", box=None, padding=(0, 2, 0, 0))
    for device in devices:
        table.add_row(device.url, device.description)
    console().print(table)
