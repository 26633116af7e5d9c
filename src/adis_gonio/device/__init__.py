"""The sensor as hardware: SPI buses by URL, the register table and the driver."""
