"""Studies: what can be asked of a model and its test besides updating."""
