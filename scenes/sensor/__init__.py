"""Camera models: they turn noise-free phasors into noisy frames. Each kind of camera has its
package."""
