import json
from dataclasses import dataclass

import numpy as np
import pytest
from graphs import SEEDS, random_poses
from hypothesis import given

from pgo_models.geometry.rotations import stack_transposes
from solvers import Status
from solvers.carry.messages import Messages, count_bytes
from solvers.carry.serialization import deserialize, serialize
from solvers.soc.recursion_block import StepSettings, block_at


@given(seed=SEEDS)
def test_arrays_and_classes_come_back_bit_by_bit_and_apart_from_the_original(seed):
    poses = random_poses(3, 3, seed)
    start = block_at(stack_transposes(poses.R), np.ones(9), np.ones(9), StepSettings(memory=2))
    block, _ = start.after_solve(np.ones((9, 3)))
    restored = deserialize(serialize({"block": block, "poses": (poses, None)}))
    assert restored["block"].anderson.residual_differences == ()
    for name in ("rho", "omega", "s", "x", "best"):
        np.testing.assert_array_equal(getattr(restored["block"], name), getattr(block, name))
    np.testing.assert_array_equal(restored["block"].anderson.image, block.anderson.image)
    np.testing.assert_array_equal(restored["poses"][0].t, poses.t)
    restored["block"].omega[:] = 0.0
    assert block.omega.any()


def test_only_arrays_of_plain_numbers_and_one_text_are_made():
    arrays = serialize({"poses": random_poses(2, 2, 0), "status": Status.CONVERGED})
    assert {array.dtype.kind for array in arrays.values()} <= set("fiUb")


def test_messages_stay_messages_and_other_mappings_stay_as_they_are():
    """A mapping that happens to be in an answer is not taken for messages to other robots."""
    answer = {"sent": Messages({3: 1.5}), "counts": {3: 2}}
    restored = deserialize(serialize(answer))
    assert type(restored["sent"]) is Messages
    assert type(restored["counts"]) is dict
    assert restored == answer
    assert count_bytes(restored["sent"]) == 0
    assert count_bytes(restored["counts"]) == 8


def test_a_class_without_a_name_is_neither_written_nor_made():
    @dataclass
    class Other:
        value: int

    with pytest.raises(TypeError, match="Other is no record with a name"):
        serialize(Other(1))
    tree = {"record": "Other", "fields": {"value": 1}}
    with pytest.raises(ValueError, match="'Other' is no record"):
        deserialize({"tree": np.array(json.dumps(tree))})
    with pytest.raises(ValueError, match="not serialized here"):
        deserialize({"0": np.zeros(2)})


@pytest.mark.parametrize(
    "tree",
    [
        {"record": "Poses", "fields": {}},
        {"record": "Poses", "fields": {"R": 1, "t": 2, "more": 3}},
        {"record": "Other", "fields": {}},
        {"enum": "Status", "member": "GONE"},
        {"array": 0},
        {"keys": ["a", "b"], "values": [1]},
        {},
    ],
)
def test_a_tree_of_another_version_is_a_value_error(tree):
    with pytest.raises(ValueError, match=r"not serialized here|zip|no record"):
        deserialize({"tree": np.array(json.dumps(tree))})


def test_what_is_no_data_is_refused():
    with pytest.raises(TypeError, match="cannot serialize"):
        serialize({"function": print})
    with pytest.raises(TypeError, match="cannot serialize the key"):
        serialize({(1, 2): 3})
