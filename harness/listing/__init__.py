"""Plug-ins, result folders and stored renders, as `harness.ls` lists and `harness.clean` removes them."""
