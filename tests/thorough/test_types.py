"""What the README writes in Python passes a strict type checker, as a user runs it elsewhere."""

import re
import sys
from pathlib import Path
from subprocess import run

ROOT = Path(__file__).parents[2]


def test_the_python_of_the_readme_is_typed(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    (tmp_path / "readme.py").write_text(code, "utf-8")
    program = [sys.executable, "-m", "mypy", "--strict", "--config-file=", "readme.py"]
    checked = run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Success" in checked.stdout, checked.stdout
