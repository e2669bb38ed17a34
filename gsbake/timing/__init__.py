"""Expected time and memory of stages, from formulas, earlier runs and the progress of the present one."""
