"""The sky: zodiacal light, by place and date."""
