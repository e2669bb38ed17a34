"""Many captures: jobs with dependencies and resources, run by Snakemake or printed for another scheduler."""
