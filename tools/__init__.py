"""Programs for those who develop polsep."""
