"""Keys, the store of results, the record of a campaign."""
