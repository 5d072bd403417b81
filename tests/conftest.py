"""What holds for all tests."""

from hypothesis import HealthCheck, settings

# How fast an example is found or runs is the machine's matter: a busy one must fail no test.
settings.register_profile("deal_hw", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("deal_hw")
