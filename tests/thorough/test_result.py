import pytest
from graphs import varied_problem

from solvers import Newton, Status, run
from solvers.result import Run


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
