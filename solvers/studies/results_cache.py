"""Finished results of a long job in a JSON file, so that the job can go on where it was interrupted.

Readers and other programs can open it, which they cannot with what joblib.Memory or diskcache keep.
"""

import json
from pathlib import Path
from typing import Any

from pgo_models.errors import FileFormatError
from pgo_models.files import read_text, replace_when_done
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.distributed.checkpoint import digest
from solvers.reporting.versions import installed_versions

Entry = dict[str, Any]


class KeptResults(dict[str, Entry]):
    """Results by key; the file, if there is one, is written anew, whole, whenever a result is added.

    Results that other versions of the software made are not taken up again, with `is_fresh` none of what it holds. A
    FileFormatError when the file is there and holds no results.
    """

    def __init__(self, path: Path | None, is_fresh: bool = False) -> None:
        self._path = path
        self._header = {"kind": "results of pgo, by key", "versions": installed_versions(None)}
        if path is not None and path.exists():
            found = self._read(path)  # in any case: a file of something else is not to be written over
            self.update({} if is_fresh else found)

    def add(self, key: str, entry: Entry) -> None:
        """Keep a result; a PGOError when the file cannot be written."""
        self[key] = entry
        if self._path is not None:
            text = json.dumps({**self._header, "results": self}, indent=1, allow_nan=False)
            with replace_when_done(self._path) as temporary:
                temporary.write_text(text + "\n", encoding="utf-8")

    def _read(self, path: Path) -> dict[str, Entry]:
        way_out = "remove it or name another file"
        try:
            content = json.loads(read_text(path))
        except json.JSONDecodeError as error:
            raise FileFormatError(path, error.lineno, f"no JSON: {error.msg}; {way_out}") from error
        if not isinstance(content, dict) or content.get("kind") != self._header["kind"]:
            raise FileFormatError(path, None, f"no results of pgo; {way_out}")
        if content.get("versions") != self._header["versions"]:
            return {}
        results = content.get("results", {})
        if not isinstance(results, dict) or not all(isinstance(entry, dict) for entry in results.values()):
            raise FileFormatError(path, None, f"no results of pgo; {way_out}")
        return results


def graph_fingerprint(graph: PoseGraph) -> str:
    """Short text that differs between graphs with different measurements or estimates."""
    poses = [] if graph.initial is None else [graph.initial.R, graph.initial.t]
    return digest(graph.i, graph.j, graph.R_ij, graph.t_ij, graph.kappa, graph.tau, *poses)[:12]
