"""Hours at one star, frame by frame: what is known of each frame, what is drawn of it, what adds up."""
