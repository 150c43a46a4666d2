"""What agents are told beside what attention sees."""
