/* A program as an owner of a Go2 would write it in C, on Cyclone DDS 0.10.2, the version the robot runs.
 *
 *   go2_peer hashes                      print the XTypes hashes of the messages
 *   go2_peer robot DOMAIN SECONDS        read rt/lowcmd and write rt/lowstate, 500 Hz
 *   go2_peer user DOMAIN SECONDS         write rt/lowcmd and read rt/lowstate, 500 Hz
 *   go2_peer stand DOMAIN PHASES         release the sport service, then the first PHASES of these four: fold,
 *                                        stand up, hold, lie down
 *
 * It talks on loopback, or on the interface that GO2_PEER_INTERFACE names in the SDKs' way, with Cyclone's default
 * quality of service as the SDKs do, and ends with one line of JSON on standard output. Cyclone's warnings go to
 * standard error: if that stays quiet, it met no bad type.
 */
#include <math.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "dds/dds.h"
#include "dds/version.h"
#include "go2_messages.h"

typedef unitree_go_msg_dds__LowCmd_ LowCmd;
typedef unitree_go_msg_dds__LowState_ LowState;
typedef unitree_api_msg_dds__Request_ Request;
typedef unitree_api_msg_dds__Response_ Response;

/* The CRC runs over these structs as they lie in memory, so their layout is part of the protocol. */
_Static_assert(sizeof(LowCmd) == 812, "LowCmd_ is not laid out as on the robot");
_Static_assert(sizeof(LowState) == 1180, "LowState_ is not laid out as on the robot");

enum { PERIOD_NS = 2000000, JOINTS = 12, MOTORS = 20, BATCH = 16 };
enum { CHECK_MODE = 1001, RELEASE_MODE = 1003, STAND_DOWN = 1005 };

static const char CONFIGURATION[] =
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface %s/></Interfaces></General>"
    "<Tracing><Verbosity>warning</Verbosity><OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>";
static const char LOOPBACK[] = "address=\"127.0.0.1\" multicast=\"true\"";

typedef struct {
  unsigned long received, bad_crc, bad_head, gaps;
  uint32_t last_tick;
} Count;

static volatile sig_atomic_t stopped = 0;

static void on_signal(int number) {
  (void)number;
  stopped = 1;
}

static dds_entity_t check(dds_entity_t code, const char *what) {
  if (code < 0) {
    fprintf(stderr, "go2_peer: %s: %s\n", what, dds_strretcode(-code));
    exit(1);
  }
  return code;
}

static dds_entity_t topic(dds_entity_t participant, const dds_topic_descriptor_t *type, const char *name) {
  return check(dds_create_topic(participant, type, name, NULL, NULL), name);
}

static dds_entity_t writer(dds_entity_t participant, const dds_topic_descriptor_t *type, const char *name) {
  return check(dds_create_writer(participant, topic(participant, type, name), NULL, NULL), name);
}

static dds_entity_t reader(dds_entity_t participant, const dds_topic_descriptor_t *type, const char *name) {
  return check(dds_create_reader(participant, topic(participant, type, name), NULL, NULL), name);
}

/* CRC-32 with polynomial 04C11DB7, most significant bit first, over all 32-bit words but the last, the CRC. */
static uint32_t crc(const void *message, size_t bytes) {
  uint32_t rest = 0xFFFFFFFFu;
  for (size_t word = 0; word + 1 < bytes / 4; word++) {
    uint32_t value;
    memcpy(&value, (const char *)message + 4 * word, 4);
    for (int bit = 31; bit >= 0; bit--) {
      uint32_t top = (rest >> 31) ^ ((value >> bit) & 1u);
      rest = (rest << 1) ^ (top ? 0x04C11DB7u : 0u);
    }
  }
  return rest;
}

static void next_period(struct timespec *when) {
  when->tv_nsec += PERIOD_NS;
  if (when->tv_nsec >= 1000000000L) {
    when->tv_nsec -= 1000000000L;
    when->tv_sec++;
  }
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, when, NULL);
}

static void idle_command(LowCmd *command) {
  memset(command, 0, sizeof *command);
  command->head[0] = 0xFE;
  command->head[1] = 0xEF;
  command->level_flag = 0xFF;
  for (int i = 0; i < MOTORS; i++) {
    command->motor_cmd[i].mode = 1;
    command->motor_cmd[i].q = 2.146e9f; /* "no position" */
    command->motor_cmd[i].dq = 16000.0f; /* "no velocity" */
  }
}

static void send_command(dds_entity_t out, LowCmd *command) {
  command->crc = crc(command, sizeof *command);
  check(dds_write(out, command), "write rt/lowcmd");
}

static void take_commands(dds_entity_t in, Count *count) {
  void *samples[BATCH] = {NULL};
  dds_sample_info_t infos[BATCH];
  int taken = check(dds_take(in, samples, infos, BATCH, BATCH), "take rt/lowcmd");
  for (int i = 0; i < taken; i++) {
    const LowCmd *command = samples[i];
    if (!infos[i].valid_data) continue;
    count->received++;
    count->bad_crc += command->crc != crc(command, sizeof *command);
    count->bad_head += command->head[0] != 0xFE || command->head[1] != 0xEF;
  }
  if (taken > 0) check(dds_return_loan(in, samples, taken), "return loan");
}

/* Keeps the newest state in `latest`; returns whether there was one. */
static bool take_states(dds_entity_t in, Count *count, LowState *latest) {
  void *samples[BATCH] = {NULL};
  dds_sample_info_t infos[BATCH];
  bool any = false;
  int taken = check(dds_take(in, samples, infos, BATCH, BATCH), "take rt/lowstate");
  for (int i = 0; i < taken; i++) {
    const LowState *state = samples[i];
    if (!infos[i].valid_data) continue;
    count->received++;
    count->bad_crc += state->crc != crc(state, sizeof *state);
    count->bad_head += state->head[0] != 0xFE || state->head[1] != 0xEF;
    if (count->received > 1 && state->tick - count->last_tick > 2) count->gaps++;
    count->last_tick = state->tick;
    memcpy(latest, state, sizeof *latest);
    any = true;
  }
  if (taken > 0) check(dds_return_loan(in, samples, taken), "return loan");
  return any;
}

static void report(const char *role, unsigned long sent, const Count *count, dds_entity_t in) {
  dds_subscription_matched_status_t matched;
  check(dds_get_subscription_matched_status(in, &matched), "matched");
  printf("{\"role\": \"%s\", \"version\": \"%s\", \"sent\": %lu, \"received\": %lu, ", role, DDS_VERSION, sent,
         count->received);
  printf("\"bad_crc\": %lu, \"bad_head\": %lu, \"gaps\": %lu, \"peers\": %u}\n", count->bad_crc, count->bad_head,
         count->gaps, matched.total_count);
}

static void run_robot(dds_entity_t participant, double seconds) {
  dds_entity_t in = reader(participant, &unitree_go_msg_dds__LowCmd__desc, "rt/lowcmd");
  dds_entity_t out = writer(participant, &unitree_go_msg_dds__LowState__desc, "rt/lowstate");
  static LowState state;
  Count count = {0};
  unsigned long sent = 0, cycles = (unsigned long)(seconds * 1e9 / PERIOD_NS);
  struct timespec when;
  memset(&state, 0, sizeof state);
  state.head[0] = 0xFE;
  state.head[1] = 0xEF;
  state.level_flag = 0xFF;
  state.imu_state.quaternion[0] = 1.0f;
  state.imu_state.accelerometer[2] = 9.81f;
  clock_gettime(CLOCK_MONOTONIC, &when);
  for (; sent < cycles && !stopped; sent++) {
    state.tick = (uint32_t)(2 * sent);
    state.motor_state[0].q = sinf((float)sent * 0.01f);
    state.crc = crc(&state, sizeof state);
    check(dds_write(out, &state), "write rt/lowstate");
    take_commands(in, &count);
    next_period(&when);
  }
  report("robot", sent, &count, in);
}

static void run_user(dds_entity_t participant, double seconds) {
  dds_entity_t out = writer(participant, &unitree_go_msg_dds__LowCmd__desc, "rt/lowcmd");
  dds_entity_t in = reader(participant, &unitree_go_msg_dds__LowState__desc, "rt/lowstate");
  static LowCmd command;
  static LowState latest;
  Count count = {0};
  unsigned long sent = 0, cycles = (unsigned long)(seconds * 1e9 / PERIOD_NS);
  struct timespec when;
  clock_gettime(CLOCK_MONOTONIC, &when);
  for (; sent < cycles && !stopped; sent++) {
    idle_command(&command);
    command.sn[0] = (uint32_t)sent;
    send_command(out, &command);
    take_states(in, &count, &latest);
    next_period(&when);
  }
  report("user", sent, &count, in);
}

/* One request to a service; returns the answer's code, or -1 after 5 s. Copies the answer's text. */
typedef struct {
  dds_entity_t out, in;
} Service;

static int32_t call(Service service, int64_t api, const char *parameter, char *text, size_t room) {
  struct timespec when;
  clock_gettime(CLOCK_MONOTONIC, &when);
  int64_t id = when.tv_sec * 1000000000LL + when.tv_nsec;
  Request request;
  memset(&request, 0, sizeof request);
  request.header.identity.id = id;
  request.header.identity.api_id = api;
  request.parameter = (char *)parameter;
  check(dds_write(service.out, &request), "write request");
  for (int cycle = 0; cycle < 2500 && !stopped; cycle++) {
    void *samples[1] = {NULL};
    dds_sample_info_t info;
    if (check(dds_take(service.in, samples, &info, 1, 1), "take response") > 0) {
      const Response *response = samples[0];
      bool ours = info.valid_data && response->header.identity.id == id;
      int32_t code = ours ? response->header.status.code : 0;
      if (ours) snprintf(text, room, "%s", response->data ? response->data : "");
      check(dds_return_loan(service.in, samples, 1), "return loan");
      if (ours) return code;
    }
    next_period(&when);
  }
  return -1;
}

/* A request that is written before the service has been found is lost; waits up to 5 s. */
static bool found(Service service) {
  dds_publication_matched_status_t asked;
  dds_subscription_matched_status_t answered;
  for (int attempt = 0; attempt < 500 && !stopped; attempt++) {
    check(dds_get_publication_matched_status(service.out, &asked), "matched");
    check(dds_get_subscription_matched_status(service.in, &answered), "matched");
    if (asked.current_count > 0 && answered.current_count > 0) return true;
    dds_sleepfor(DDS_MSECS(10));
  }
  return false;
}

static Service service(dds_entity_t participant, const char *name) {
  char requests[64], responses[64];
  snprintf(requests, sizeof requests, "rt/api/%s/request", name);
  snprintf(responses, sizeof responses, "rt/api/%s/response", name);
  Service made = {writer(participant, &unitree_api_msg_dds__Request__desc, requests),
                  reader(participant, &unitree_api_msg_dds__Response__desc, responses)};
  return made;
}

/* Returns whether CheckMode's answer, like {"form": "0", "name": "normal"}, names a mode; copies the name. */
static bool mode_in(const char *answer, char *name, size_t room) {
  const char *at = strstr(answer, "\"name\"");
  name[0] = 0;
  if (at && (at = strchr(at + 6, ':')) && (at = strchr(at, '"'))) {
    size_t length = strcspn(at + 1, "\"");
    snprintf(name, room, "%.*s", (int)length, at + 1);
  }
  return name[0] != 0;
}

/* Until no mode is left: ask, lie down, release. Returns how many releases it took, or -1. */
static int release_sport_mode(dds_entity_t participant, char *first_mode, size_t room) {
  Service switcher = service(participant, "motion_switcher"), sport = service(participant, "sport");
  char text[512], name[64];
  int releases = 0;
  if (!found(switcher)) return -1;
  found(sport);
  for (int attempt = 0; attempt < 10 && !stopped; attempt++) {
    int32_t code = call(switcher, CHECK_MODE, "{}", text, sizeof text);
    if (code == 0 && !mode_in(text, name, sizeof name)) return releases;
    if (code == 0) {
      if (releases == 0) snprintf(first_mode, room, "%s", name);
      call(sport, STAND_DOWN, "{}", text, sizeof text);
      if (call(switcher, RELEASE_MODE, "{}", text, sizeof text) == 0) releases++;
    }
    dds_sleepfor(DDS_SECS(1));
  }
  return -1;
}

/* Length of thigh and of calf, as in the robot's public models. */
static const float LINK_M = 0.213f;

/* Poses of the SDK's low-level example, wire order: front right, front left, rear right, rear left; hip, thigh,
 * calf. */
static const float FOLDED[JOINTS] = {0.0f,  1.36f, -2.65f, 0.0f, 1.36f, -2.65f,
                                     -0.2f, 1.36f, -2.65f, 0.2f, 1.36f, -2.65f};
static const float STANDING[JOINTS] = {0.0f, 0.67f, -1.3f, 0.0f, 0.67f, -1.3f,
                                       0.0f, 0.67f, -1.3f, 0.0f, 0.67f, -1.3f};
static const float LYING[JOINTS] = {-0.35f, 1.36f, -2.65f, 0.35f, 1.36f, -2.65f,
                                    -0.5f,  1.36f, -2.65f, 0.5f,  1.36f, -2.65f};

typedef struct {
  const char *name;
  const float *target;
  int cycles;
} Phase;

static const Phase PHASES[] = {
    {"fold", FOLDED, 500}, {"stand", STANDING, 500}, {"hold", STANDING, 1000}, {"lie", LYING, 900}};

static float worst_error(const LowState *state, const float *target) {
  float worst = 0;
  for (int i = 0; i < JOINTS; i++) worst = fmaxf(worst, fabsf(state->motor_state[i].q - target[i]));
  return worst;
}

/* How far the least stretched leg's foot is below its hip [m], from the joints. */
static float shortest_leg(const LowState *state) {
  float shortest = 1;
  for (int leg = 0; leg < JOINTS; leg += 3) {
    float thigh = state->motor_state[leg + 1].q, calf = state->motor_state[leg + 2].q;
    shortest = fminf(shortest, LINK_M * (cosf(thigh) + cosf(thigh + calf)));
  }
  return shortest;
}

static int lightest_foot(const LowState *state) {
  int lightest = state->foot_force[0];
  for (int foot = 1; foot < 4; foot++)
    if (state->foot_force[foot] < lightest) lightest = state->foot_force[foot];
  return lightest;
}

static void run_stand(dds_entity_t participant, size_t asked) {
  size_t known = sizeof PHASES / sizeof *PHASES, phases = asked < known ? asked : known;
  char mode[64] = "";
  dds_entity_t out = writer(participant, &unitree_go_msg_dds__LowCmd__desc, "rt/lowcmd");
  dds_entity_t in = reader(participant, &unitree_go_msg_dds__LowState__desc, "rt/lowstate");
  static LowCmd command;
  static LowState latest;
  Count count = {0};
  struct timespec when;
  float from[JOINTS];
  int releases = release_sport_mode(participant, mode, sizeof mode);
  if (releases < 0) {
    fprintf(stderr, "go2_peer: the sport service was not released\n");
    exit(2);
  }
  clock_gettime(CLOCK_MONOTONIC, &when);
  for (int cycle = 0; !take_states(in, &count, &latest) && !stopped; cycle++) {
    if (cycle >= 2500) {
      fprintf(stderr, "go2_peer: no rt/lowstate within 5 s\n");
      exit(3);
    }
    next_period(&when);
  }
  printf("{\"role\": \"stand\", \"version\": \"%s\", \"mode\": \"%s\", ", DDS_VERSION, mode);
  printf("\"releases\": %d, \"phases\": [", releases);
  idle_command(&command);
  for (size_t phase = 0; phase < phases && !stopped; phase++) {
    const float *start = phase ? PHASES[phase - 1].target : from;
    float effort = 0;
    for (int i = 0; phase == 0 && i < JOINTS; i++) from[i] = latest.motor_state[i].q;
    for (int cycle = 1; cycle <= PHASES[phase].cycles && !stopped; cycle++) {
      float part = (float)cycle / (float)PHASES[phase].cycles;
      for (int i = 0; i < JOINTS; i++) {
        command.motor_cmd[i].q = (1 - part) * start[i] + part * PHASES[phase].target[i];
        command.motor_cmd[i].dq = 0;
        command.motor_cmd[i].kp = 60;
        command.motor_cmd[i].kd = 5;
        command.motor_cmd[i].tau = 0;
        effort = fmaxf(effort, fabsf(latest.motor_state[i].tau_est));
      }
      send_command(out, &command);
      take_states(in, &count, &latest);
      next_period(&when);
    }
    printf("%s{\"phase\": \"%s\", \"worst_error\": %.4f, ", phase ? ", " : "", PHASES[phase].name,
           worst_error(&latest, PHASES[phase].target));
    printf("\"worst_effort\": %.2f, \"roll\": %.4f, \"pitch\": %.4f, ", effort, latest.imu_state.rpy[0],
           latest.imu_state.rpy[1]);
    printf("\"shortest_leg\": %.4f, \"lightest_foot\": %d}", shortest_leg(&latest), lightest_foot(&latest));
  }
  printf("], \"received\": %lu, \"bad_crc\": %lu, \"bad_head\": %lu, \"gaps\": %lu}\n", count.received,
         count.bad_crc, count.bad_head, count.gaps);
}

/* The type information is CDR: minimal and complete section, each with its hash behind 20 bytes of headers. */
static void print_hashes(const dds_topic_descriptor_t *type) {
  const unsigned char *at = type->type_information.data;
  uint32_t length;
  memcpy(&length, at + 8, 4);
  printf("%s ", type->m_typename);
  for (int i = 0; i < 14; i++) printf("%02x", at[21 + i]);
  printf(" ");
  for (int i = 0; i < 14; i++) printf("%02x", at[12 + length + 17 + i]);
  printf("\n");
}

int main(int argc, char **argv) {
  const char *role = argc > 1 ? argv[1] : "";
  bool timed = strcmp(role, "robot") == 0 || strcmp(role, "user") == 0;
  if (strcmp(role, "hashes") == 0) {
    print_hashes(&unitree_go_msg_dds__LowCmd__desc);
    print_hashes(&unitree_go_msg_dds__LowState__desc);
    print_hashes(&unitree_hg_msg_dds__LowCmd__desc);
    print_hashes(&unitree_hg_msg_dds__LowState__desc);
    print_hashes(&unitree_go_msg_dds__SportModeState__desc);
    print_hashes(&unitree_go_msg_dds__WirelessController__desc);
    print_hashes(&unitree_api_msg_dds__Request__desc);
    print_hashes(&unitree_api_msg_dds__Response__desc);
    return 0;
  }
  if (argc != 4 || (!timed && strcmp(role, "stand") != 0)) {
    fprintf(stderr, "usage: go2_peer hashes | robot DOMAIN SECONDS | user DOMAIN SECONDS | stand DOMAIN PHASES\n");
    return 64;
  }
  dds_domainid_t domain = (dds_domainid_t)strtoul(argv[2], NULL, 10);
  signal(SIGTERM, on_signal);
  signal(SIGINT, on_signal);
  const char *interface = getenv("GO2_PEER_INTERFACE");
  char where[128], configuration[512];
  snprintf(where, sizeof where, interface ? "name=\"%s\" multicast=\"default\"" : "%s",
           interface ? interface : LOOPBACK);
  snprintf(configuration, sizeof configuration, CONFIGURATION, where);
  check(dds_create_domain(domain, configuration), "create domain");
  dds_entity_t participant = check(dds_create_participant(domain, NULL, NULL), "create participant");
  if (strcmp(role, "robot") == 0) run_robot(participant, strtod(argv[3], NULL));
  if (strcmp(role, "user") == 0) run_user(participant, strtod(argv[3], NULL));
  if (strcmp(role, "stand") == 0) run_stand(participant, strtoul(argv[3], NULL, 10));
  fflush(stdout);
  check(dds_delete(participant), "delete participant");
  return 0;
}
