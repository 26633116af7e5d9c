"""The trace: from the residual of a session to the missing effect, and to a model corrected for it.

>>> import adis_gonio
>>> result = adis_gonio.trace(adis_gonio.load_session("session.csv"))  # doctest: +SKIP
>>> [finding.effect for finding in result.found]  # doctest: +SKIP
['bias']

`adis_gonio.tracing.trace.trace` is the function.
"""
