"""Significance levels and probabilities of sets. Each decides what a result claims: a change moves answers.

Numbers of the trace's own search are in `adis_gonio.tracing.thresholds`, limits of a bring-up in
`adis_gonio.bench.bringup.limits`.
"""

INADEQUATE = 0.01
"""p-value of χ² below which a residual is too large for the noise that was measured."""
FOUND_WITHIN = 0.01
"""Probability that a session without faults shows any finding inside its dwells (family-wise)."""
FOUND_IN_ONE_POSE = 0.01
"""Probability that one pose without effects shows one, over all candidates."""
OUTLYING = 0.01
"""Probability that a fleet without any outlying unit, stage or operator names one (family-wise)."""
DRIFTING = 0.05
"""Probability of a drift claimed where none is, over all quantities of a sensor (Bonferroni)."""
SLOW_NOISE = 0.025
"""One-sided level of a noise process: its interval of 95 % leaves zero."""
LINE_IN_NOISE = 1e-4
"""Probability that noise alone shows a spectral line in a record at rest."""
LINK_REFUSED = 1e-3
"""p-value below which links by gyros contradict gravity."""
COMMON_DIVISOR = 1e-6
"""Probability that differences of words have a common divisor by chance."""
POSITION_QUESTIONED = 1e-4
"""Probability that one position of a sound part is questioned: one in a hundred tumbles of 100."""
CREDIBLE_SET = 0.95
"""Least probability of a set of names in one session."""
POPULATION_SET = 0.99
"""Least probability of a set of names in a population of sessions."""
