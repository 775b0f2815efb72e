"""What carries messages between robots, and what counts them. Nothing here knows an algorithm.

| file | what it has |
|---|---|
| `messages`, `moments` | orders to workers, messages between them, and what workers return to |
| `process`, `ray_engine` | engines: robots in this process or in Ray actors |
| `ray_cluster` | joining Ray, or starting it for this machine alone |
| `counted_pool`, `ledger` | workers whose messages are counted, and the account |
| `faults` | messages that are lost or late, for study |
| `registry`, `serialization` | names of orders and records with a version; records as arrays |
| `field_types` | whether what arrives has the types that a record declares |
| `wire`, `letters` | sealed bytes; what two robots tell each other while a third one drives |
"""
