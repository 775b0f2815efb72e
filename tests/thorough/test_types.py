"""What README and guide write in Python passes a strict type checker, as users run it elsewhere."""

import re
import sys
from doctest import DocTestParser
from pathlib import Path
from subprocess import run

ROOT = Path(__file__).parents[2]
# Others show wrong code, names of a reader's own program, or fields that only some answers have.
PAGES = ("looks_wrong", "readings", "robots", "rotations", "teach")


def test_the_python_of_readme_and_guide_is_typed(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    (tmp_path / "readme.py").write_text(code, "utf-8")
    for page in PAGES:
        text = (ROOT / "notebooks" / "site" / "guide" / f"{page}.md").read_text("utf-8")
        examples = DocTestParser().get_examples(text)
        assert examples, page
        code = "".join(example.source for example in examples)
        (tmp_path / f"{page}.py").write_text(code, "utf-8")
    # cvxpy re-exports its functions without saying so.
    options = ["--strict", "--implicit-reexport", "--config-file="]
    program = [sys.executable, "-m", "mypy", *options, "readme.py", *(f"{p}.py" for p in PAGES)]
    checked = run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Success" in checked.stdout, checked.stdout
