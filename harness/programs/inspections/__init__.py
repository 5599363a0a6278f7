"""`tofpod pod`, `design`, `gauge`: limits of real inspections, and the targets that they need."""
