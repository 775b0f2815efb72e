"""How far a run is: a line that is drawn anew, a table, a bar."""
