"""How many examples hypothesis draws: all of them under HYPOTHESIS_PROFILE=all, seven tenths under
`thorough`, which CI has time for, and a quarter else.
"""

import os

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "light")
EXAMPLES = {"light": 25, "thorough": 70, "all": 100}[PROFILE]


def examples(at_most: int) -> int:
    """Examples of a test that draws fewer, or more, than others."""
    return max(3, at_most * EXAMPLES // 100)
