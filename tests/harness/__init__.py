"""What several tests share: hands, buses, daemons and terminals to test with."""
