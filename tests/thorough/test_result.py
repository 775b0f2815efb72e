import numpy as np
import pytest
from graphs import varied_problem

from solvers import Measurement, Newton, Status
from solvers.loop import run
from solvers.result import History, Record, Run


def history() -> History:
    return History(
        tuple(
            Record(k, 0.5 * k, Measurement(10.0 - k, 1.0 / (k + 1), 2.0 / (k + 1)))
            for k in range(3)
        )
    )


def test_a_history_is_its_records_column_by_column() -> None:
    records = history()
    assert len(records) == 3
    np.testing.assert_array_equal(records.k, [0, 1, 2])
    np.testing.assert_array_equal(records.seconds, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(records.objective, [10.0, 9.0, 8.0])
    np.testing.assert_array_equal(records.primal_residual, [1.0, 1 / 2, 1 / 3])
    np.testing.assert_array_equal(records.dual_residual, [2.0, 1.0, 2 / 3])


def test_an_empty_history_has_empty_columns() -> None:
    for column in (History().k, History().seconds, History().objective, History().primal_residual):
        assert column.shape == (0,)
    assert len(History()) == 0


@pytest.mark.parametrize("status", Status)
def test_only_what_did_as_asked_is_a_success(status: Status) -> None:
    assert status.is_success == (status in (Status.CONVERGED, Status.STALLED))
    assert status.value


def test_a_run_prints_its_status_beside_its_value() -> None:
    problem = varied_problem(0, 6, 2)
    text = repr(run(Newton(), problem))
    assert text.startswith("Run(Newton: CONVERGED after ")
    assert "F = " in text
    unfinished: Run[object] = run(Newton(max_iterations=0), problem)
    assert repr(unfinished).startswith("Run(Newton: MAX_ITERATIONS after 0 iterations, F = ")


def test_measurements_and_records_compare_by_value() -> None:
    assert Measurement(1.0, 2.0, 3.0) == Measurement(1.0, 2.0, 3.0)
    assert Record(0, 0.0, Measurement(1.0, 2.0, 3.0)) != Record(1, 0.0, Measurement(1.0, 2.0, 3.0))
    assert Measurement(1.0, 2.0, 3.0).infeasibility == 0.0
