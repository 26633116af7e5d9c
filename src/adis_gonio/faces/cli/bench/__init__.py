"""The faces of a bench session: each shows the events of a runner and gives its answers."""
