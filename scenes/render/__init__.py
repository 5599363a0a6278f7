"""Light transport with Mitsuba 3: from a target before a camera to the noise-free view that the sensor sees."""
