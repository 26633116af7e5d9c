"""`adis-gonio serve`."""

from __future__ import annotations

import ipaddress

import click

from adis_gonio.device.sensor import DEFAULT_SCAN, open_sensor
from adis_gonio.device.sensor.registers import registers as rows_of
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.serve import PORT, IioServer, ServeSettings


@click.command("serve")
@option.url
@option.shown(
    "--iio", "port", type=click.IntRange(0, 65535), default=PORT, help="TCP port; 0 takes a free one."
)
@option.shown(
    "--listen",
    "host",
    default="127.0.0.1",
    help="Address to listen on; 0.0.0.0 is every one of this machine.",
)
@click.option("--allow-writes", is_flag=True, help="Let clients write calibbias, rate and filter.")
@click.option("--registers", "names", help="Registers to serve, separated by commas.", metavar="NAME,…")
@option.variant
@option.no_check
def command(
    *,
    url: str,
    port: int,
    host: str,
    allow_writes: bool,
    names: str | None,
    variant: str,
    no_check: bool,
) -> None:
    """Serve the sensor as an IIO device to libiio's clients (iio_info, iio_readdev, pyadi-iio).

    Ends at Ctrl-C or SIGTERM. The sensor streams while a client has a buffer open; where the bridge can use
    data-ready it is enabled for that time and set back. Anybody who reaches the address can connect, there
    is no password: the address is this machine's own unless --listen says otherwise.
    """
    chosen = tuple(row.name for row in rows_of(names.split(","))) if names else DEFAULT_SCAN

    def ready(address: str, taken: int) -> None:
        click.echo(
            f"{url}: served as iio:device0 at ip:{address}:{taken},"
            f" {'clients may write' if allow_writes else 'read-only'}; Ctrl-C ends it",
            err=True,
        )
        if not _is_loopback(address):
            click.echo("whoever reaches this address can connect; there is no password", err=True)

    with open_sensor(url, variant=variant, check=not no_check) as sensor:
        settings = ServeSettings(host, port, allow_writes, chosen)
        IioServer(sensor, settings, tell=lambda line: click.echo(line, err=True), ready=ready).run()


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback
