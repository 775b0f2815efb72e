"""Robots that solve together: what one robot knows and does, their driver, and where they solve.

A robot (`agent`) was given its part of a graph, or has lines of its own. It holds a value,
`interior.Interior`: its part with the factors that hold for all poses (`system.FactoredPart`), and
a state (`state.InteriorState`). An order is a function of that value and a request; it returns the
value after it and an answer. What an algorithm keeps between its orders, with the eliminated
matrix, is the record of its session, of which a robot has one at a time.

| file | what it has |
|---|---|
| `setup`, `own_file` | the set-up: numbers, what is shared, cost, cover; orders for own lines |
| `consistency` | pairwise consistency of robots with own lines |
| `driver`, `interface` | the poses of the cover, and the sparse factor of what is shared |
| `start`, `translations`, `current_poses` | the start, best translations, taking and saving poses |
| `soc`, `consensus`, `paper` | SOC with a driver, robot by robot, and as published |
| `newton`, `climb` | Newton, and the climb of the staircase |
| `proof`, `proof_of_robot` | the lower bound: by the driver, and a robot's part of it |
| `handedness`, `handedness_of_robot` | terms that tell rotations from reflections, likewise |
| `reweigh`, `revision` | weights of a robust solve; edges that come back |
| `elimination`, `subdomain_blocks` | the algebra of Schur complements, and its rounding |
| `place`, `kept_answer` | the place of a solve, and the answer that robots keep |
| `place_without_driver` | the place of a solve by CONSENSUS alone |
| `checkpoint` | what a solve writes to go on from |
"""
