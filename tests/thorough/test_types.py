"""What README and guide write in Python passes a strict type checker, as users run it elsewhere."""

import re
import sys
from doctest import DocTestParser
from pathlib import Path
from subprocess import run

ROOT = Path(__file__).parents[2]
# Shows what doors convert: names of settings and seeds, which annotations leave out.
CONVERTS = "own_splitting"


def test_the_python_of_readme_and_guide_is_typed(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    (tmp_path / "readme.py").write_text(code, "utf-8")
    for page in (ROOT / "notebooks" / "site" / "guide").glob("*.md"):
        code = "".join(e.source for e in DocTestParser().get_examples(page.read_text("utf-8")))
        if code and page.stem != CONVERTS:
            (tmp_path / f"{page.stem}.py").write_text(code, "utf-8")
    # Readers' own functions have no annotations, cvxpy and plotly not all of theirs.
    (tmp_path / "mypy.ini").write_text("[mypy]\n[mypy-plotly.*]\nignore_missing_imports = True\n")
    options = ["--strict", "--implicit-reexport", "--allow-untyped-defs", "--allow-untyped-calls"]
    pages = sorted(path.name for path in tmp_path.glob("*.py"))
    program = [sys.executable, "-m", "mypy", *options, *pages]
    checked = run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Success" in checked.stdout, checked.stdout
