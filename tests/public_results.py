"""Public classes whose objects functions make."""

# Users only read them: their fields are not checked once more.
RESULTS = {"Certificate", "ModelCertificate", "QuadraticForm", "GraphQP", "Measurement", "Solution"}
