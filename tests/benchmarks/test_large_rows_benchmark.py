"""What the paper's tables are to show on the large graphs; it takes a minute or two, so it runs
when it is named.
"""

import os

import pytest

from solvers import reproduce_tables
from solvers.studies.paper_tables import ReproductionSettings
from solvers.studies.paper_tables_text import findings


@pytest.mark.skipif(
    not os.environ.get("PGO_DATA"), reason="PGO_DATA names the folder with the public graphs"
)
@pytest.mark.parametrize("name", ["cubicle", "torus3D"])
def test_large_graphs_show_what_they_should(name: str) -> None:
    found = findings(reproduce_tables(ReproductionSettings(only=(name,))))
    assert found
    assert not [str(finding) for finding in found if finding.failed or not finding.held]
