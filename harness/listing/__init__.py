"""What `harness.ls` lists and `harness.clean` removes: plug-ins, result folders, stored renders."""
