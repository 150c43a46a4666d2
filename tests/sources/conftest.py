"""Settings of the property tests of this folder."""

from hypothesis import HealthCheck, settings

# The first example of each test pays for the shape checks' compilation.
settings.register_profile(
    "sources", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("sources")
