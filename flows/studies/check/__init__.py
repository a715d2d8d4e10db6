"""What `modetune check` looks at before anything costs a licence."""
