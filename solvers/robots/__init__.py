"""Robots that solve together: what one robot knows and does, their driver, and where they solve.

A robot (`agent`) was given its part of a graph, or has lines of its own. It holds a value,
`part.Interior`: its part with the factors that hold for all poses (`elimination.FactoredPart`), and
a state (`part.InteriorState`). An order is a function of that value and a request; it returns the
value after it and an answer. What an algorithm keeps between its orders, with the eliminated
matrix, is the record of its session, of which a robot has one at a time. The file of an algorithm
has what the driver does, and below that the orders that robots obey.

| file | what it has |
|---|---|
| `setup`, `own_file` | the set-up: numbers, what is shared, cost, cover; orders for own lines |
| `consistency` | pairwise consistency of robots with own lines |
| `agent`, `part` | a robot, and what it has after the set-up |
| `elimination`, `subdomain_blocks` | the algebra of Schur complements, and its rounding |
| `driver`, `interface` | the poses of the cover, and the sparse factor of what is shared |
| `poses` | taking and saving poses, best translations, and the start |
| `soc`, `consensus`, `paper` | SOC with a driver, robot by robot, and as published |
| `newton`, `climb` | Newton, and the climb of the staircase |
| `proof` | the lower bound |
| `reweigh`, `revision` | weights of a robust solve; edges that come back |
| `place`, `kept_answer` | the place of a solve, and the answer that robots keep |
| `place_without_driver` | the place of a solve by CONSENSUS alone |
| `checkpoint` | what a solve writes to go on from |
"""
