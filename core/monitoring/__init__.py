"""A structure over its nights: parameters, their environment, and whether they changed."""
