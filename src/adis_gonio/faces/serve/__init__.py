"""The sensor as an IIO device over the network protocol of libiio's iiod.

`protocol` is the grammar, `device` the channels, attributes and the XML, `queues` a client's scans: these
three do no I/O. `sampler` is the one reader of the sensor, `hub` deals its scans out, `client` answers one
connection, `server` joins them.
"""

from adis_gonio.faces.serve.server import PORT, IioServer, ServeSettings

__all__ = ["PORT", "IioServer", "ServeSettings"]
