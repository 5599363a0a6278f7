"""`tofpod pod`, `design` and `gauge`: limits of real inspections, and the targets they need."""
need."""
