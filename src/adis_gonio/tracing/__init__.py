"""Residual → missing effect → corrected model → error before and after.

>>> import adis_gonio
>>> result = adis_gonio.trace(adis_gonio.load_session("session.csv"))  # doctest: +SKIP
>>> [finding.effect for finding in result.found]  # doctest: +SKIP
['bias']

`adis_gonio.tracing.trace.trace` is the function.
"""
