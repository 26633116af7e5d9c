"""Any Linux IIO accelerometer, of this machine or by network, as a source of samples: `iio:` URLs.

`channels` says what a scan's bytes mean (no I/O), `local` and `network` are two ways to a device behind the
contract of `device`, `source` makes a session's source of one.
"""

from adis_gonio.bench.iio.source import IioMeasuring, IioSource, open_from_url

__all__ = ["IioMeasuring", "IioSource", "open_from_url"]
