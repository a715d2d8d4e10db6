"""A campaign in the browser while it runs, and what is set there by hand."""
