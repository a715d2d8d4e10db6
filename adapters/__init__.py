"""One folder a solver, one file a test format: text and files in, typed values out."""
