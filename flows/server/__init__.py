"""modetune's Prefect server: started, deployed to, shown on."""
