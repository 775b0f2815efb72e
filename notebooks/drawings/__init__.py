"""Pictures and films of the notebooks, one module for each notebook that links to it.

The notebooks show the mathematics; what only draws is here, and several draw with `traces`.
"""
