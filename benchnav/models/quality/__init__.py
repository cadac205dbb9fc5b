"""How good a model is: measures, tables and figures."""
