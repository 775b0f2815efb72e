"""Finished results of a long job in a JSON file, so that an interrupted job can be continued.

People and other programs can read that file, unlike the files of joblib.Memory or diskcache.
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
    """Results by key; the whole file, if one is given, is written again when a result is added.

    Results of other versions of the software are ignored, with `is_fresh` all results in the file.
    Raises a FileFormatError if the file exists and is not one of results.
    """

    def __init__(self, path: Path | None, is_fresh: bool = False) -> None:
        self._path = path
        self._header = {"kind": "results of pgo, by key", "versions": installed_versions(None)}
        if path is not None and path.exists():
            # The file is read in any case, so that a file of another kind is not overwritten.
            results = self._read(path)
            if not is_fresh:
                self.update(results)

    def add(self, key: str, entry: Entry) -> None:
        """Keep a result; raises a PGOError if the file cannot be written."""
        self[key] = entry
        if self._path is not None:
            text = json.dumps({**self._header, "results": self}, indent=1, allow_nan=False)
            with replace_when_done(self._path) as temporary:
                temporary.write_text(text + "\n", encoding="utf-8")

    def _read(self, path: Path) -> dict[str, Entry]:
        """Results in the file; none if other versions of the software made them."""
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
        is_valid = isinstance(results, dict) and all(
            isinstance(entry, dict) for entry in results.values()
        )
        if not is_valid:
            raise FileFormatError(path, None, f"no results of pgo; {way_out}")
        return dict(results)


def graph_fingerprint(graph: PoseGraph) -> str:
    """Short text that tells graphs with different measurements or estimates apart."""
    poses = [] if graph.initial is None else [graph.initial.R, graph.initial.t]
    return digest(graph.i, graph.j, graph.R_ij, graph.t_ij, graph.kappa, graph.tau, *poses)[:12]
