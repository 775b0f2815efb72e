"""What one robot knows and does.

A robot of the substructured coupling is a value, `interior.Interior`: its part of the graph with
the factors that hold for all poses (`system.FactoredPart`), and a state (`state.InteriorState`).
The files are divided by what of that state an algorithm reads and writes. All share poses and cost;
the eliminated matrix, and what an algorithm keeps beside it, is the record of its session, of which
a robot has one at a time:

| file | orders of | session in `state` |
|---|---|---|
| `current_poses` | taking, saving and evaluating poses, and the choice of the cost | none |
| `translations` | the best translations of given rotations | none: M_tt serves all rotations |
| `start` | chordal relaxation, rotation averaging | `RelaxationSession`, `AveragingSession` |
| `recursion` | SOC | `RecursionSession` |
| `descent` | Newton | `DescentSession` |
| `proof_orders`, with `proof` | the lower bound | `ProofSession` |
| `climbing` | the staircase: inverse iteration, then the climb | `ProofSession`, `DescentSession` |
| `handedness` | the ascent of handedness terms | `ProofSession`; terms and ascent outlast it |
| `reweighting` | weights of a robust solve, which outlast sessions | none |

An order is a function of the value and a request, and returns the value after it and an answer
(`records`). `agent` holds the value, applies orders to it, and keeps moments and snapshots of it;
`own_file` is an agent that loads a file. `elimination` and `subdomain_blocks` are the algebra of
Schur complements.
"""
