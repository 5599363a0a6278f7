"""The user's own camera: measured from static captures, reproduced by a camera file, with a page
and a certificate."""
