"""Options that commands of `pgo` share, and the words that they take."""

import enum
import math
from pathlib import Path
from typing import Annotated

import typer

# Words that options take; their values are the names in lower case, unless given.

# The first stage of a solve.
FirstStage = enum.StrEnum("FirstStage", "JOINT SUBSTRUCTURED CONSENSUS PAPER NEWTON")
Start = enum.StrEnum("Start", "CHORDAL TREE ODOMETRY FILE")
# How poses go to robots.
Split = enum.StrEnum("Split", "GIVEN CONTIGUOUS METIS SINGLETONS")
# Where robots run.
Runner = enum.StrEnum("Runner", "PROCESS THREADS RAY")
# Edges that a robust solve takes for right (`Known`), and how wrong ones are found.
TakenForRight = enum.StrEnum("TakenForRight", "AUTO NONE ODOMETRY")
Robust = enum.StrEnum("Robust", {"GNC": "gnc", "GM": "gm", "PCM": "pcm", "PCM_GNC": "pcm-gnc"})
Scene = enum.StrEnum(
    "Scene",
    {
        "CIRCLE": "circle",
        "GRID": "grid",
        "SPHERE": "sphere",
        "RANDOM": "random",
        "GRID_WORLD": "grid-world",
        "VICTORIA_PARK": "victoria-park",
    },
)


class Cost(enum.Enum):
    """The cost that a command minimises or judges by."""

    CHI2 = "chi2"
    ISOTROPIC = "isotropic"
    UNIT = "unit"


def _finite_gap(gap: float) -> float:
    if not 0 < gap < math.inf:
        raise typer.BadParameter(f"{gap} is no positive, finite number; 1e-6 is usual")
    return gap


def _standard_input(graph: str) -> str:
    return "/dev/stdin" if graph == "-" else graph


GraphArgument = Annotated[
    str,
    typer.Argument(
        callback=_standard_input,
        metavar="GRAPH",
        help="A g2o file, - for one on standard input, a folder with one file a robot, or the name "
        "of a data set (see pgo info).",
    ),
]
SplitOption = Annotated[
    Split | None,
    typer.Option(
        help="How poses go to robots: as in the file, else with few cut edges (METIS), else "
        "contiguous."
    ),
]
RotationsOption = Annotated[
    bool,
    typer.Option(
        "--rotations",
        help="Estimate and certify rotations alone (rotation averaging): the cost is the rotation "
        "part of F. A file whose edges have only rotations needs no such option.",
    ),
]
CostOption = Annotated[
    Cost | None,
    typer.Option(
        help="chi2: of the file's information matrices, the default where it has them; isotropic: "
        "F, two precisions an edge, as in SE-Sync; unit: F with the weights of the paper."
    ),
]
DropCouplingOption = Annotated[
    bool,
    typer.Option(
        "--drop-coupling",
        help="Solve for chi2 without the coupling blocks that make matrices indefinite, and say of "
        "how many edges; without this option the cost of such a file is F.",
    ),
]
SkipUnknownOption = Annotated[
    bool,
    typer.Option(
        "--skip-unknown", help="Skip lines of a g2o file with unknown tags, and say which."
    ),
]
LargestComponentOption = Annotated[
    bool,
    typer.Option(
        "--largest-component",
        help="Take the largest component of a graph in parts, and say what is left out: other "
        "parts, and poses without edges.",
    ),
]
AllComponentsOption = Annotated[
    bool,
    typer.Option(
        "--all-components",
        help="Solve every component of a graph in parts, each on its own; files of the second are "
        "named NAME.2, and so on.",
    ),
]
EstimateNoiseOption = Annotated[
    bool,
    typer.Option(
        "--estimate-noise",
        help="Find the noise of odometry and closures from how well they fit each other, say what "
        "it is, and take the weights of it, whatever matrices the file has.",
    ),
]
TrustFolderOption = Annotated[
    bool,
    typer.Option(
        "--trust-folder",
        help="Take the files of a folder to be of one graph whatever speaks against it: the same "
        "ids are the same poses, and nearly equal edges all count.",
    ),
]
ProofOption = Annotated[
    Path | None,
    typer.Option(
        help="Write the proof of the lower bound as JSON, for pgo verify; it is of the file that "
        "was solved, or of the one that --out writes where edges were left out."
    ),
]
GapOption = Annotated[float, typer.Option(callback=_finite_gap, help="Relative gap to certify.")]
UnitWeightsOption = Annotated[
    bool,
    typer.Option(
        "--unit-weights",
        help="The cost is F with kappa = tau = 1, the weights of the paper's equation.",
    ),
]
DropEdgeOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LINE",
        help="Leave out the edge on this line of the file (FILE:LINE); may be repeated.",
    ),
]
