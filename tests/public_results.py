"""Public classes whose objects functions make."""

# Users only read them: their fields are not checked once more.
RESULTS = {
    *("Certificate", "EdgeResiduals", "EvaluatedPoses", "GraphQP", "HandednessTerms", "LowerBound"),
    *("PoseVariables", "RelaxationSolution", "RotationQP", "Term", "Verification", "Marginals"),
    *("Comparison", "EdgeFit", "FolderSolution"),
    *("History", "Ledger", "Measurement", "NoiseSweep", "OrthogonalSolution"),
    *("Outcome", "RSubproblem", "Record", "Rejection", "Reproduction", "Run", "Solution", "Stage"),
    *("Traffic", "OutlierProof", "ReadingComparison", "ReadingFit", "NoiseEstimate", "NoiseLevel"),
}
