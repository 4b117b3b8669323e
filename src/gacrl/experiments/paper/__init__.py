"""The paper's experiment: its runs, tables, claims and grid search."""
