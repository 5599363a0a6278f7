"""`tofpod coverage`: where on a part damage of a size is found, and which poses help."""
