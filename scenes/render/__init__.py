"""Light transport with Mitsuba 3: computes the noise-free view of a target that a camera's sensor
receives."""
