"""`tofpod ls`, `clean` and `prepare`: what is there, what can go, what is compiled once."""
