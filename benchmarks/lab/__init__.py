"""Tables of the pages in docs/lab, written from the rows in benchmarks/results: `python -m benchmarks.lab`."""
