"""`python -m adis_gonio`."""

from adis_gonio.faces.cli import run

run()
