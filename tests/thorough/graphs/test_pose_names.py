from dataclasses import replace
from pathlib import Path

import numpy as np

from pgo_models import random_geometric, write_g2o
from pgo_models.graphs.g2o import edge_places, pose_names, symbol_ids


def test_symbols_are_named_by_letter_and_index_and_edges_by_their_line(tmp_path: Path) -> None:
    graph = random_geometric(12, np.random.default_rng(0))
    named = replace(graph, ids=symbol_ids(np.arange(12) // 6))
    assert pose_names(graph)[5:8] == ["5", "6", "7"]
    assert pose_names(named)[5:8] == ["a5", "b0", "b1"]
    path = tmp_path / "named.g2o"
    write_g2o(named, path)
    first = (int(named.pose_ids[named.i[0]]), int(named.pose_ids[named.j[0]]))
    line = path.read_text().splitlines()[int(edge_places(path)[0].rpartition(":")[2]) - 1]
    assert line.startswith(f"EDGE_SE3:QUAT {first[0]} {first[1]} ")
