"""The interfaces to people and programs: command line, terminal screen, server, Python functions."""
