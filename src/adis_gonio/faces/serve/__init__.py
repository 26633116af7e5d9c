"""The sensor as an IIO device over the network protocol of libiio's iiod.

`iiod_protocol` is the grammar and `iio_device` the channels, attributes and XML; neither does I/O.
`iio_device` has the only reader of the sensor and distributes its scans, `iio_server` answers the clients.
"""

from adis_gonio.faces.serve.iio_server import PORT, IioServer, ServeSettings

__all__ = ["PORT", "IioServer", "ServeSettings"]
