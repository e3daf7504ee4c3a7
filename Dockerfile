# servobus as a daemon: docker build -t servobus . && docker run --device /dev/ttyUSB0 -v ./servobus.yaml:/etc/servobus/servobus.yaml:ro servobus
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml constraints.txt README.md ./
COPY servobus servobus
RUN python -m venv /opt/servobus && /opt/servobus/bin/pip install --no-cache-dir --constraint constraints.txt '.[speed]'

FROM python:3.11-slim
# Serial devices belong to the group dialout (20); the user has no other right.
RUN useradd --uid 10001 --gid 20 --no-create-home --shell /usr/sbin/nologin servobus
COPY --from=build /opt/servobus /opt/servobus
ENV PATH=/opt/servobus/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
USER 10001:20
# SIGTERM applies each servo's on_exit; parking may take its park_timeout, so give `docker stop -t` that long.
STOPSIGNAL SIGTERM
ENTRYPOINT ["servobus"]
CMD ["run", "/etc/servobus/servobus.yaml"]
