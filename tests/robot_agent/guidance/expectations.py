"""Plans of neighbours, and the limits by which they are judged."""

from shoal.config.controller import MpcConfig, Safety

PERIOD_S, NS = 0.05, 1_000_000_000
CONFIG, SAFETY = MpcConfig(), Safety()
STEPS = CONFIG.horizon + 1
