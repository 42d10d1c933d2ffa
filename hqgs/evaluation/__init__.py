"""How good a scene is: metrics, held-out views, the report."""
