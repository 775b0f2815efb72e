"""Pictures of graphs, matrices and curves, by matplotlib and plotly."""
