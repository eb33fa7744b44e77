"""The runs of an experiment on the workers of a Dask cluster."""
