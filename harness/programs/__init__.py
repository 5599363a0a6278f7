"""The programs beside the core, one room for each: its command, statistics, tables and page."""
