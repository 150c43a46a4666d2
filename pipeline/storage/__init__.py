"""Storage: Zarr groups, Parquet tables, weights, source files and splits."""
