"""`python -m adis_gonio`."""

from adis_gonio.cli import run

run()
