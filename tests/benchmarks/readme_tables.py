"""Runs the paper's tables anew and puts them into the README, between its two marks, and draws the README's comparison.

PGO_DATA=folder-with-the-graphs python tests/benchmarks/readme_tables.py
"""

import os
import re
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import pgo_models as pgo
import solvers

ROOT = Path(__file__).parents[2]
README, PICTURE = ROOT / "README.md", ROOT / "notebooks" / "pictures" / "compare-cubicle.png"
MARKS = "<!-- pgo tables -->\n", "<!-- end of pgo tables -->"
COMPARED = "cubicle"

if __name__ == "__main__":
    tables = solvers.tables_as_text(solvers.reproduce_tables())
    tables.print()
    tables.save(ROOT / "notebooks" / "tables.json")  # which notebook 7 loads
    before, _, after = re.split(f"(?<={MARKS[0]})(.*?)(?={MARKS[1]})", README.read_text(encoding="utf-8"), flags=re.S)
    README.write_text(f"{before}\n{tables.markdown()}\n{after}", encoding="utf-8")
    comparison = solvers.compare_methods(pgo.load(COMPARED))
    comparison.table().print()
    comparison.save_plot(PICTURE)
