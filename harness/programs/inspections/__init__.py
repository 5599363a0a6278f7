"""`tofpod pod`, `design` and `gauge`: limits of real inspections, and how many targets they need."""
