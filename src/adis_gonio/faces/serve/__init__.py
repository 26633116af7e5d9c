"""The sensor as an IIO device over the network protocol of libiio's iiod.

`iiod_protocol` reads requests and formats answers. `iio_device` has the channels, attributes and
XML, and the only reader of the sensor, which distributes its scans. `iio_server` answers the clients.
"""

from adis_gonio.faces.serve.iio_server import PORT, IioServer

__all__ = ["PORT", "IioServer"]
