"""A robot with a file of its own is whole at every time, and tells by its record what it knows."""

from contextlib import closing
from pathlib import Path

import pytest
from graphs import varied_graph
from robots import Recording, contiguous

from pgo_models import Weighting
from pgo_models.graphs.g2o import write_g2o_folder
from solvers.distributed.own_files import open_files
from solvers.distributed.robots import own_file
from solvers.distributed.robots.own_file import FileAgent, PlacedFile


def test_an_agent_has_the_same_attributes_before_and_after_it_is_set_up(tmp_path: Path) -> None:
    graph = varied_graph(2, 12, 3)
    write_g2o_folder(graph.with_robots(contiguous(graph, 2).robot), tmp_path)
    files = [(robot, tmp_path / f"{robot}.g2o") for robot in range(3)]
    engine = Recording()
    with closing(open_files(files, engine, 1e9, Weighting.ISOTROPIC).driver):
        for file, agent in zip(files, engine.agents, strict=True):
            assert vars(agent).keys() == vars(FileAgent(file)).keys()
            assert isinstance(agent.record, PlacedFile)
            assert agent.subgraph is agent.record.subgraph


def test_an_order_before_its_turn_is_a_defect(tmp_path: Path) -> None:
    graph = varied_graph(2, 12, 3)
    write_g2o_folder(graph.with_robots(contiguous(graph, 2).robot), tmp_path)
    agent = FileAgent((0, tmp_path / "0.g2o"))
    own_file.read_file(agent, None)
    with pytest.raises(AssertionError):
        own_file.take_cost(agent, Weighting.ISOTROPIC)
    with pytest.raises(AssertionError):
        own_file.propose_poses(agent, 8)
