"""How many examples hypothesis draws, and whether they are the same in every run.

They are, unless HYPOTHESIS_PROFILE=drawn: then there are more of them, drawn anew from the seed
that `--hypothesis-seed` names.
"""

import os

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "fixed")
EXAMPLES = {"fixed": 25, "drawn": 70}[PROFILE]


def examples(at_most: int) -> int:
    """Examples of a test that draws fewer, or more, than others: `at_most` of a hundred."""
    return max(3, at_most * EXAMPLES // 100)
