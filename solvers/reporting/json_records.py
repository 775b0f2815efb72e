"""What `.json` files hold of a certificate, of stages and of a network."""

import json
from pathlib import Path

from pgo_models.certificates.certificate import Certificate
from pgo_models.files import replace_when_done
from pgo_models.graphs.partitioning import Partition
from solvers.carry.ledger import Ledger
from solvers.reporting.result_table import finite_or_none
from solvers.result import Stage


def certificate_json(certificate: Certificate) -> dict[str, object]:
    """What `.json` files hold of a certificate; None stands for what is not known.

    Three entries may be None: `eta` if no shift was proved, `objective_error` if no bound on it is
    known, and `stationarity` if it was not measured. `exact_to` is the largest residual of an edge
    over what it measures, where the verdict is EXACT.
    """
    return {
        "lower_bound": certificate.lower_bound,
        "gap": certificate.gap,
        "proven_gap": certificate.proven_gap,
        "wanted_gap": certificate.wanted_gap,
        "eta": finite_or_none(certificate.eta),
        "grounded": certificate.bound.is_grounded,
        "rounding": certificate.bound.rounding,
        "objective_error": finite_or_none(certificate.objective_error),
        "weights_error": certificate.weights_error,
        "digits": certificate.digits,
        "stationarity": finite_or_none(certificate.stationarity),
        "verdict": certificate.verdict.name,
        "exact_to": finite_or_none(certificate.fit.share),
    }


def stage_json(stage: Stage) -> dict[str, object]:
    """What `.json` files hold of a stage: its attempt is 0 of one that is part of none."""
    return {
        "name": stage.name,
        "attempt": stage.attempt,
        "status": stage.status.name,
        "reason": stage.reason,
        "iterations": stage.iterations,
        "objective": stage.objective,
        "seconds": stage.seconds,
    }


def network_json(ledger: Ledger, robots: Partition) -> dict[str, object]:
    """What `.json` files hold of robots and of what they sent."""
    network = {
        "rounds": ledger.rounds,
        "all_reduces": ledger.all_reduces,
        "messages": ledger.messages,
        "bytes": ledger.num_bytes,
        "snapshot_bytes": ledger.snapshot_bytes,
        "graph_bytes": ledger.graph_bytes,
        "bytes_sent": ledger.bytes_sent.tolist(),
        "bytes_received": ledger.bytes_received.tolist(),
    }
    return {"robots": robots.robot.tolist(), "network": network}


def write_json(record: dict[str, object], path: Path) -> None:
    """Write a record, whole or not at all."""
    with replace_when_done(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")
