/* A Video4Linux camera for programs that preload this library: the device of the path in FAKE_CAMERA. It takes 20 gray
 * pictures per second of 64 by 48 pixels. The first eight bytes of a picture are the time when it was taken, in
 * microseconds of the monotonic clock; the buffer is filled 15 ms later. FAKE_CAMERA_FLAGS are the buffers' flags, and
 * FAKE_CAMERA_AHEAD_US is added to their stamps. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { WIDTH = 64, HEIGHT = 48, SIZE = WIDTH * HEIGHT, MAX_BUFFERS = 8, PERIOD_US = 50000, TRANSFER_US = 15000 };

static int device = -1;
static unsigned count;
static unsigned char *memory[MAX_BUFFERS];
static struct v4l2_buffer filled[MAX_BUFFERS];
static unsigned queued[MAX_BUFFERS], done[MAX_BUFFERS], queued_count, done_count, sequence;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static unsigned take_first(unsigned *list, unsigned *length) {
    unsigned first = list[0];
    memmove(list, list + 1, --*length * sizeof *list);
    return first;
}

static int64_t now_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000;
}

static void *take_pictures(void *unused) {
    const char *flags = getenv("FAKE_CAMERA_FLAGS"), *ahead = getenv("FAKE_CAMERA_AHEAD_US");
    for (int64_t due = now_us();; due += PERIOD_US) {
        while (now_us() < due) usleep(200);
        int64_t taken = now_us();
        usleep(TRANSFER_US);
        pthread_mutex_lock(&lock);
        sequence++;
        if (queued_count > 0) {
            unsigned index = take_first(queued, &queued_count);
            memcpy(memory[index], &taken, sizeof taken);
            int64_t stamp = taken + (ahead ? atoll(ahead) : 0);
            filled[index].bytesused = SIZE;
            filled[index].flags = flags ? strtoul(flags, NULL, 0) : 0;
            filled[index].timestamp.tv_sec = stamp / 1000000;
            filled[index].timestamp.tv_usec = stamp % 1000000;
            filled[index].sequence = sequence;
            done[done_count++] = index;
            eventfd_write(device, 1);
        }
        pthread_mutex_unlock(&lock);
    }
    return unused;
}

static int refuse(int error) {
    errno = error;
    return -1;
}

static void describe(struct v4l2_format *format) {
    memset(&format->fmt, 0, sizeof format->fmt);
    format->fmt.pix.width = WIDTH;
    format->fmt.pix.height = HEIGHT;
    format->fmt.pix.pixelformat = V4L2_PIX_FMT_GREY;
    format->fmt.pix.field = V4L2_FIELD_NONE;
    format->fmt.pix.bytesperline = WIDTH;
    format->fmt.pix.sizeimage = SIZE;
}

static int answer(unsigned long request, void *argument) {
    struct v4l2_buffer *buffer = argument;
    pthread_t camera;
    eventfd_t one;
    switch (request) {
    case VIDIOC_ENUM_FMT: {
        struct v4l2_fmtdesc *format = argument;
        format->pixelformat = V4L2_PIX_FMT_GREY;
        return format->index == 0 ? 0 : refuse(EINVAL);
    }
    case VIDIOC_G_FMT:
    case VIDIOC_S_FMT:
        describe(argument);
        return 0;
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM:
        return 0;
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *wish = argument;
        count = wish->count = wish->count < MAX_BUFFERS ? wish->count : MAX_BUFFERS;
        return 0;
    }
    case VIDIOC_QUERYBUF:
        if (buffer->index >= count) return refuse(EINVAL);
        buffer->length = SIZE;
        buffer->m.offset = buffer->index * 4096;
        return 0;
    case VIDIOC_QBUF:
        pthread_mutex_lock(&lock);
        queued[queued_count++] = buffer->index;
        pthread_mutex_unlock(&lock);
        return 0;
    case VIDIOC_STREAMON:
        return pthread_create(&camera, NULL, take_pictures, NULL) == 0 ? 0 : refuse(EIO);
    case VIDIOC_STREAMOFF:
        return 0;
    case VIDIOC_DQBUF: {
        if (buffer->memory != V4L2_MEMORY_MMAP) return refuse(EINVAL);
        if (eventfd_read(device, &one) != 0) return refuse(EAGAIN);
        pthread_mutex_lock(&lock);
        unsigned index = take_first(done, &done_count);
        *buffer = filled[index];
        buffer->index = index;
        pthread_mutex_unlock(&lock);
        return 0;
    }
    default:
        return refuse(ENOTTY);
    }
}

static int opened(const char *path, int flags, mode_t mode) {
    const char *fake = getenv("FAKE_CAMERA");
    if (fake == NULL || strcmp(path, fake) != 0) return openat(AT_FDCWD, path, flags, mode);
    int number = eventfd(0, EFD_SEMAPHORE | EFD_NONBLOCK | EFD_CLOEXEC);
    /* The library opens the device to read and write; a test of its existence only to read. */
    if ((flags & O_ACCMODE) == O_RDWR) device = number;
    return number;
}

int open(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = va_arg(rest, mode_t);
    va_end(rest);
    return opened(path, flags, mode);
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = va_arg(rest, mode_t);
    va_end(rest);
    return opened(path, flags, mode);
}

void *mmap(void *start, size_t length, int protection, int flags, int number, off_t offset) {
    if (device < 0 || number != device) return (void *)syscall(SYS_mmap, start, length, protection, flags, number, offset);
    memory[offset / 4096] = calloc(1, length);
    return memory[offset / 4096];
}

int munmap(void *start, size_t length) {
    for (int index = 0; index < MAX_BUFFERS; index++)
        if (start == memory[index]) return 0;
    return (int)syscall(SYS_munmap, start, length);
}

/* The library calls the kernel without the C library's `ioctl`. */
long syscall(long number, ...) {
    static long (*real)(long, ...);
    long argument[6];
    va_list rest;
    va_start(rest, number);
    for (int i = 0; i < 6; i++) argument[i] = va_arg(rest, long);
    va_end(rest);
    if (number == SYS_ioctl && device >= 0 && argument[0] == device) return answer(argument[1], (void *)argument[2]);
    if (real == NULL) real = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
    return real(number, argument[0], argument[1], argument[2], argument[3], argument[4], argument[5]);
}
