"""Runs the paper's tables anew, puts them between the two marks of README.md beside this file,
draws its comparison.

PGO_DATA=folder-with-the-graphs python tests/benchmarks/readme_tables.py
"""

import os
import re
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import pgo_models as pgo
import solvers
from solvers.studies.paper_tables_text import tables_as_text

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).with_name("README.md")
PICTURE = ROOT / "notebooks" / "pictures" / "compare-cubicle.png"
MARKS = "<!-- pgo tables -->\n", "<!-- end of pgo tables -->"
COMPARED = "cubicle"

if __name__ == "__main__":
    tables = tables_as_text(solvers.reproduce_tables())
    tables.print()
    tables.save(ROOT / "notebooks" / "tables.json")  # which notebook 7 loads
    before, _, after = re.split(
        f"(?<={MARKS[0]})(.*?)(?={MARKS[1]})", PAGE.read_text(encoding="utf-8"), flags=re.S
    )
    PAGE.write_text(f"{before}\n{tables.markdown()}\n{after}", encoding="utf-8")
    comparison = solvers.compare_methods(pgo.load(COMPARED))
    comparison.table().print()
    comparison.save_plot(PICTURE)
