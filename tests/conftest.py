"""How Python runs all tests."""

import gc

# Tracing a graph makes millions of objects that live on. Looking through them as often as Python does by default takes
# a tenth of the time of such tests.
gc.set_threshold(100_000, 20, 100)
