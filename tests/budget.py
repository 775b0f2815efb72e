"""How many of the examples that tests name hypothesis draws: HYPOTHESIS_PROFILE=light, thorough (as CI) or full."""

import os

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "light")
EXAMPLES = {"light": 25, "thorough": 60, "full": 100}[PROFILE]


def examples(full: int) -> int:
    """Examples of a test that draws fewer, or more, than others."""
    return max(3, full * EXAMPLES // 100)
