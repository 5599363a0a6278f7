"""Everything from frames to findings; runs on real captures without Mitsuba. Knows nothing of scenes."""
