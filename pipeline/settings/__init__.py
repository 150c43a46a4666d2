"""Settings: ``stages.yaml`` and the command line to frozen records."""
