"""What a campaign leaves to look at."""
