"""One observation and its signal to noise: simulate, snr, exposure."""
