"""How many examples hypothesis draws: all of them under HYPOTHESIS_PROFILE=thorough, a quarter
else.
"""

import os

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "light")
EXAMPLES = {"light": 25, "thorough": 100}[PROFILE]


def examples(thorough: int) -> int:
    """Examples of a test that draws fewer, or more, than others."""
    return max(3, thorough * EXAMPLES // 100)
